"""Fields given by their samples on a grid, interpolated by cubic splines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import InputError
from ..surface.polygons import Floats
from .grid_file import read


@dataclass(frozen=True)
class SampledField:
    """The spline of ``coefficients (A, B, C)``; sample ``(i, j, k)`` is at ``origin + spacing *
    (i, j, k)``. Beyond the samples it grows with the square of the distance from them."""

    coefficients: Floats
    origin: Floats
    spacing: Floats

    @property
    def box(self) -> Floats:
        """Of the samples, ``(2, 3)``."""
        last = np.array(self.coefficients.shape) - 1
        return np.stack([self.origin, self.origin + self.spacing * last])

    def value_and_gradient(self, points: Floats) -> tuple[Floats, Floats]:
        """At ``points (N, 3)``: ``(N,)`` and ``(N, 3)``; 100 times faster than torch's."""
        from .spline import values_and_gradients

        points = np.ascontiguousarray(points, dtype=np.float64)
        value, slope = np.empty(len(points)), np.empty((len(points), 3))
        values_and_gradients(self.coefficients, self.origin, self.spacing, points, value, slope)
        return value, slope

    def __call__(self, x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
        if xp is np:
            return self.value_and_gradient(np.stack([x, y, z], axis=-1))[0]
        coefficients = xp.as_tensor(self.coefficients)
        places, weights, beyond = [], [], 0.0
        for axis, at in enumerate((x, y, z)):
            count = self.coefficients.shape[axis]
            place = (at - self.origin[axis]) / self.spacing[axis]
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


def load(path: Path) -> SampledField:
    """The samples in ``path``: an array of three dimensions in a .npy file (origin 0, spacing 1),
    ``values``, ``origin (3,)`` and ``spacing`` (one or three) in a .npz file, NRRD or VTI.

    Raises InputError for anything else, for samples that are not finite, nowhere negative, or
    negative at the border.
    """
    from scipy.ndimage import spline_filter

    found = read(path)
    values = found.values
    if values.ndim != 3 or min(values.shape) < 4:
        raise InputError(
            f"{path}: holds samples of shape {values.shape}; a field needs three dimensions of at "
            "least four samples"
        )
    values = np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise InputError(
            f"{path}: {int((~np.isfinite(values)).sum())} samples are not finite; fill them in"
        )
    if not (values < 0).any():
        raise InputError(f"{path}: no sample is negative, so nothing is inside; negate the field?")
    inner = values[1:-1, 1:-1, 1:-1]
    if (values < 0).sum() != (inner < 0).sum():
        raise InputError(
            f"{path}: the field is negative at the border of its grid, where the inside would be "
            "cut off; add a layer of positive samples"
        )
    return SampledField(spline_filter(values, order=3, mode="mirror"), found.origin, found.spacing)
