"""Fields given by their samples on a grid, interpolated by cubic splines."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...formats.grid_file import read
from ...mesh.polygons import Floats

LABELS = 16
"""Samples of no more values than this are labels, not a field."""
SMOOTHINGS, SMOOTHING = 4, 0.8
"""How often the distances of labels are smoothed, and the Gaussian's width in the least spacing."""
LEAST = 0.05
"""The least distance of a sample of a label from the surface, in the least spacing."""
FILLED = 0.9
"""Share of a side of the grid from which on the inside fills it."""


@dataclass(frozen=True)
class SampledField:
    """The spline of ``coefficients (A, B, C)``; sample ``(i, j, k)`` is at ``origin + axes @
    (spacing * (i, j, k))``, where the columns of ``axes (3, 3)`` are unit vectors. Beyond the
    samples it grows with the square of the distance from them."""

    coefficients: Floats
    origin: Floats
    spacing: Floats
    axes: Floats = field(default_factory=lambda: np.eye(3))
    notes: tuple[str, ...] = ()
    """What is to be said of how they were understood."""

    @property
    def box(self) -> Floats:
        """Of the samples, ``(2, 3)``."""
        ends = self.axes * (self.spacing * (np.array(self.coefficients.shape) - 1))
        low, high = np.minimum(ends, 0).sum(axis=1), np.maximum(ends, 0).sum(axis=1)
        return np.stack([self.origin + low, self.origin + high])

    @cached_property
    def along(self) -> Floats | None:
        """What a point from the origin on is multiplied by, ``(3, 3)``, to have its place along
        each of the axes; None where these are those of space."""
        if np.array_equal(self.axes, np.eye(3)):
            return None
        return np.asarray(np.linalg.inv(self.axes), dtype=np.float64)

    def value_and_gradient(self, points: Floats) -> tuple[Floats, Floats]:
        """At ``points (N, 3)``: ``(N,)`` and ``(N, 3)``; 100 times faster than torch's."""
        from .spline import values_and_gradients

        points, origin = np.ascontiguousarray(points, dtype=np.float64), self.origin
        if self.along is not None:
            points, origin = (points - origin) @ self.along.T, np.zeros(3)
        value, slope = np.empty(len(points)), np.empty((len(points), 3))
        values_and_gradients(self.coefficients, origin, self.spacing, points, value, slope)
        return value, slope if self.along is None else slope @ self.along

    def __call__(self, x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
        if xp is np:
            return self.value_and_gradient(np.stack([x, y, z], axis=-1))[0]
        coefficients = xp.as_tensor(self.coefficients)
        places, weights, beyond = [], [], 0.0
        from_origin = [at - start for at, start in zip((x, y, z), self.origin, strict=True)]
        if self.along is not None:
            from_origin = [
                sum(factor * at for factor, at in zip(row, from_origin, strict=True))
                for row in self.along.tolist()
            ]
        for axis, at in enumerate(from_origin):
            count = self.coefficients.shape[axis]
            place = at / self.spacing[axis]
            within = xp.clip(place, 0.0, count - 1.0)
            beyond = beyond + (self.spacing[axis] * (place - within)) ** 2
            first = xp.clip(xp.floor(within), 0.0, count - 2.0)
            places.append(first.long())
            weights.append(_weights(within - first))
        total: Any = 0.0
        for i in range(4):
            for j in range(4):
                for k in range(4):
                    index = tuple(
                        _mirrored(place + step - 1, size, xp)
                        for place, step, size in zip(
                            places, (i, j, k), coefficients.shape, strict=True
                        )
                    )
                    weight = weights[0][i] * weights[1][j] * weights[2][k]
                    total = total + weight * coefficients[index]
        # Squares: a root has no derivative where nothing is beyond.
        return total + beyond / float(self.spacing.mean())


def _weights(t: Any) -> list[Any]:
    """Of the four cubic B-splines about a point ``t`` of the way between the middle two."""
    u = 1 - t
    return [
        u * u * u / 6,
        (4 - 6 * t * t + 3 * t * t * t) / 6,
        (4 - 6 * u * u + 3 * u * u * u) / 6,
        t * t * t / 6,
    ]


def _mirrored(index: Any, size: int, xp: ModuleType) -> Any:
    """Indices beyond the ends, reflected in the outermost samples."""
    index = xp.abs(index)
    return xp.where(index > size - 1, 2 * (size - 1) - index, index)


def load(path: Path, above: float | None = None) -> SampledField:
    """The samples in ``path``: an array of three dimensions in a .npy file (origin 0, spacing 1),
    ``values``, ``origin (3,)`` and ``spacing`` (one or three) in a .npz file, or a volume of one of
    ``grid_file.READERS``.

    Inside is what is negative, or with ``above`` what is more than that; of samples of two values,
    one of which is zero, the other one. Raises InputError for anything else, for samples that are
    not finite or have no inside, and, without ``above``, where that reaches the border.
    """
    from scipy.ndimage import spline_filter

    found = read(path)
    values = found.values
    if values.ndim != 3 or min(values.shape) < 4:
        raise InputError(
            f"{path}: has samples of shape {values.shape}, but a field needs three "
            "dimensions of at least four samples"
        )
    values = np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise InputError(
            f"{path}: {int((~np.isfinite(values)).sum())} samples are not finite; fill them in"
        )
    low, high = float(values.min()), float(values.max())
    spread = f"its values go from {low:g} to {high:g}"
    label = _few(values)
    if above is None and label and low == 0.0:
        above = 0.0
    if above is not None:
        if not low <= above < high:
            raise InputError(f"{path}: {spread}, so none of them is above --level {above:g}")
        values = above - values
    middle = f"--level {0.5 * (low + high):.3g} takes what is above that value as the inside"
    if not (values < 0).any():
        raise InputError(f"{path}: {spread}: none is negative, so nothing is inside; {middle}")
    notes, origin = list(found.notes), found.origin
    if (values < 0).sum() != (values[1:-1, 1:-1, 1:-1] < 0).sum():
        if above is None:
            raise InputError(
                f"{path}: {spread}, and they are negative at the border of the grid, where the "
                f"inside would be cut off; {middle}, or add a layer of positive samples"
            )
        notes.append("the inside reaches the border of the grid: it is cut off and closed there")
        # Half a spacing beyond the border, and still growing behind that.
        for factor in (1.0, 3.0):
            inner = values.shape
            values, origin = np.pad(values, 1, mode="edge"), origin - found.axes @ found.spacing
            beyond = np.pad(np.zeros(inner, dtype=bool), 1, constant_values=True)
            values[beyond] = factor * np.abs(values[beyond])
    elif _fills(values[1:-1, 1:-1, 1:-1] < 0):
        notes.append(
            "the inside fills the grid up to its border, so it may be the air around "
            f"a body; if the body is what lies above a value, {middle}"
        )
    if label:
        notes.append("the samples are labels: a smooth surface between them stands for the shape")
        values = _smooth(values < 0, found.spacing)
    coefficients = spline_filter(values, order=3, mode="mirror")
    return SampledField(coefficients, origin, found.spacing, found.axes, tuple(notes))


def _few(values: Floats) -> bool:
    """Whether there are so few different values that they are labels."""
    at = values.ravel()
    # Most fields tell by their first samples, so not all of them have to be sorted.
    return (
        all(
            len(np.unique(part)) <= LABELS
            for part in (at[: 100 * LABELS], at[:: len(at) // 10_000 + 1])
        )
        and len(np.unique(at)) <= LABELS
    )


def _fills(inside: NDArray[np.bool_]) -> bool:
    """Whether ``inside (A, B, C)`` covers most of all six sides."""
    sides = [np.take(inside, end, axis) for axis in range(3) for end in (0, -1)]
    return all(side.mean() > FILLED for side in sides)


def _smooth(inside: NDArray[np.bool_], spacing: Floats) -> Floats:
    """A field that is negative at the samples ``inside`` and nowhere else, and smooth between them:
    their distance to the other ones, by turns smoothed and put back to its sign (as in Gibson
    1998)."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    unit = spacing / spacing.min()
    away, within = (distance_transform_edt(part, sampling=unit) for part in (~inside, inside))
    least = np.where(inside, -LEAST, LEAST)
    values = np.where(inside, 0.5 - within, away - 0.5)
    for _ in range(SMOOTHINGS):
        # Smoothed once would shrink what is round; the difference of a second time puts that back.
        once = gaussian_filter(values, SMOOTHING / unit, mode="nearest")
        values = 2 * once - gaussian_filter(once, SMOOTHING / unit, mode="nearest")
        values = np.where(inside, np.minimum(values, least), np.maximum(values, least))
    return np.asarray(values * spacing.min())
