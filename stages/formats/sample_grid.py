"""Samples on a grid in space, whose axes may be rotated."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from .arrays_file import LARGEST

ROUNDING = 1e-6
"""Components of an axis that are smaller are taken as rounding, because headers have few digits."""
FLAT = 1e-3
"""Axes span space if the volume of their unit vectors is larger."""


@dataclass(frozen=True)
class Samples:
    """Samples ``values (A, B, C)`` on a grid.

    Sample ``(i, j, k)`` is at ``origin + axes @ (spacing * (i, j, k))``. The columns of
    ``axes (3, 3)`` are unit vectors.
    """

    values: NDArray[Any]
    origin: Floats
    spacing: Floats
    axes: Floats = field(default_factory=lambda: np.eye(3))
    notes: tuple[str, ...] = ()
    """Sentences about assumptions that were made."""


def placed(
    values: NDArray[Any], origin: Floats, steps: Floats, notes: tuple[str, ...] = ()
) -> Samples:
    """The samples ``values (A, B, C)`` whose first one is at ``origin (3,)``.

    Column k of ``steps (3, 3)`` leads from a sample to the next one along axis k. If the axes are
    along x, y and z, they are put in this order and direction. Raises ValueError if that is not a
    grid in space.
    """
    if values.ndim != 3 or origin.shape != (3,) or steps.shape != (3, 3):
        raise ValueError("it is not a grid of three dimensions")
    spacing = np.linalg.norm(steps, axis=0)
    if not (np.isfinite(origin).all() and np.isfinite(spacing).all() and (spacing > 0).all()):
        raise ValueError("its origin or its axes are not finite, or its spacing is zero")
    axes = steps / spacing
    if abs(np.linalg.det(axes)) < FLAT:
        raise ValueError("its axes lie in one plane")
    along = np.abs(axes).argmax(axis=0)
    across = axes.copy()
    across[along, np.arange(3)] = 0.0
    if len(set(along.tolist())) < 3 or np.abs(across).max() > ROUNDING:
        return Samples(values, origin, spacing, axes, notes)
    order = np.argsort(along)
    values, step = values.transpose(order), steps[along, np.arange(3)][order]
    for axis in np.flatnonzero(step < 0):
        values = np.flip(values, int(axis))
        origin = origin + np.eye(3)[axis] * step * (values.shape[axis] - 1)
    return Samples(values, origin, np.abs(step), notes=notes)


def count_of(shape: tuple[int, ...]) -> int:
    """The number of samples of a shape. Raises ValueError if the shape is
    impossible or too large."""
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"its samples have shape {shape}")
    count = int(np.prod(np.array(shape, dtype=object)))
    if count > LARGEST:
        raise ValueError(f"{count} samples are more than {LARGEST}; thin them")
    return count
