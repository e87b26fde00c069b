"""Samples on a grid in space, whose axes may be turned."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from .arrays_file import LARGEST

ROUNDING = 1e-6
"""Share of an axis across those of space that is taken for rounding, since headers have so many
digits."""
FLAT = 1e-3
"""Volume of the unit vectors along the axes from which on these span space."""


@dataclass(frozen=True)
class Samples:
    """``values (A, B, C)``; sample ``(i, j, k)`` is at ``origin + axes @ (spacing * (i, j, k))``,
    where the columns of ``axes (3, 3)`` are unit vectors."""

    values: NDArray[Any]
    origin: Floats
    spacing: Floats
    axes: Floats = field(default_factory=lambda: np.eye(3))
    notes: tuple[str, ...] = ()
    """What is to be said of how they were understood."""


def placed(
    values: NDArray[Any], origin: Floats, steps: Floats, notes: tuple[str, ...] = ()
) -> Samples:
    """The samples ``values (A, B, C)`` from ``origin (3,)`` on, where column k of ``steps (3, 3)``
    leads to the next one along axis k. Axes along x, y and z are put in this order, upward.

    Raises ValueError where that is no grid in space.
    """
    if values.ndim != 3 or origin.shape != (3,) or steps.shape != (3, 3):
        raise ValueError("it is no grid of three dimensions")
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
    """The number of samples. Raises ValueError for impossible shapes."""
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"its samples have shape {shape}")
    count = int(np.prod(np.array(shape, dtype=object)))
    if count > LARGEST:
        raise ValueError(f"{count} samples are more than {LARGEST}; thin them")
    return count
