"""Interior and exterior voxels of a source (paper's appendix C.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..mesh.polygons import Floats
from ..mesh.voxels import BAND, VoxelGrid, exterior_band
from .source import Source

COARSE = 30
"""Voxels along the longest side of the first pass."""
ROUNDS = 35
"""``N_round``: random samples in a voxel; it is interior if any is inside."""
VOXELS_AT_ONCE = 2_000_000


def _interior(
    source: Source,
    origin: Floats,
    spacing: float,
    shape: tuple[int, ...],
    random: Callable[[int], np.random.Generator],
    tick: Callable[[], None],
) -> NDArray[np.bool_]:
    """Voxels with any of ROUNDS random samples inside; found ones are not asked again, and ones
    without any surface in them only once."""
    interior = np.zeros(shape, dtype=bool).reshape(-1)
    unsure = source.may_cross(origin, spacing, shape).reshape(-1)
    for number in range(ROUNDS):
        left = np.flatnonzero(~interior & (unsure if number else True))
        stream = random(number)
        for start in range(0, len(left), VOXELS_AT_ONCE):
            part = left[start : start + VOXELS_AT_ONCE]
            index = np.stack(np.unravel_index(part, shape), axis=1)
            points = origin + (index + stream.random((len(part), 3))) * spacing
            interior[part] = source.inside(points)
        tick()
    return interior.reshape(shape)


def classify(
    source: Source,
    n_init: int,
    random: Callable[[str, int], np.random.Generator],
    tick: Callable[[], None] = lambda: None,
) -> VoxelGrid:
    """The two passes of the appendix: a tight box on a 30^3 grid, then ``n_init`` voxels along it.

    ``random(pass name, round)`` gives the generator of one round; ``tick`` is called after each of
    the 70 rounds. Raises InputError when no sample is inside.
    """
    low, high = source.bounding_box()
    coarse = float((high - low).max()) / COARSE
    shape = tuple(int(np.ceil(side / coarse - 1e-9)) for side in high - low)
    found = _interior(source, low, coarse, shape, lambda i: random("box", i), tick)
    if not found.any():
        raise InputError(
            f"{source.path or source.name}: no sample lies inside the shape; check "
            "that its surface is closed, or raise -n"
        )
    occupied = np.argwhere(found)
    first, last = occupied.min(axis=0), occupied.max(axis=0) + 1
    tight_low, tight_high = low + first * coarse, low + last * coarse
    spacing = float((tight_high - tight_low).max()) / n_init
    counts = np.ceil((tight_high - tight_low) / spacing - 1e-9).astype(np.int64)
    # The grid is centred on the tight box; the margin holds the band and the distance smoothing.
    margin = BAND + 2
    origin = 0.5 * (tight_low + tight_high) - 0.5 * counts * spacing
    fine = _interior(source, origin, spacing, tuple(counts), lambda i: random("grid", i), tick)
    interior = np.pad(fine, margin)
    return VoxelGrid(origin - margin * spacing, spacing, interior, exterior_band(interior))
