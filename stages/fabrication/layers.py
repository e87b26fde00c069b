"""The layers of an object as a printer builds them, on a grid of the nozzle's width."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..mesh.polygons import Floats, Ints

MOST_CELLS = 600
"""Largest number of cells along the longest side of a layer. Beyond it the grid is
coarser than the nozzle."""
FINER = 4
"""Factor by which the grid is finer when an island is looked at again."""
LEAST_ISLAND = 4
"""Smallest number of cells of an island. Smaller ones are artefacts of the grid."""


@dataclass(frozen=True)
class Islands:
    """Parts of layers that have nothing under them."""

    places: Floats
    """The centres ``(K, 3)`` of the islands in mm, the widest first."""
    areas: Floats
    """The areas of the islands in mm^2."""
    layers: int
    empty_layers: int


def islands(vertices: Floats, triangles: Ints, layer: float, nozzle: float) -> Islands:
    """The parts of each layer that touch no part of the layer below, not even diagonally.

    What seems to be one is looked at again on a finer grid, because a part that is narrower than
    the nozzle may connect it with the rest of its layer.
    """
    below: NDArray[np.bool_] | None = None
    places, areas, suspects = [], [], []
    count = empty = filled = 0
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    pitch = max(nozzle, float((high - low)[:2].max()) / MOST_CELLS)
    heights = np.arange(low[2] + 0.5137 * layer, high[2], layer)
    for z, mask, _ in sections(vertices, triangles, heights, pitch):
        count += 1
        # A tip may end between two grid points. An empty layer with nothing above it is no gap.
        if mask.any():
            filled += 1
            empty = count - filled
        if below is not None and _loose(_grown(below), mask, LEAST_ISLAND):
            suspects.append(z)
        below = mask
    fine = pitch / FINER
    for z in suspects:
        pair = sections(vertices, triangles, np.array([z - layer, z]), fine)
        (_, below, _), (_, mask, origin) = pair
        for _ in range(FINER):
            below = _grown(below)
        for cells in _loose(below, mask, LEAST_ISLAND * FINER**2):
            places.append([*(origin + fine * (cells.mean(axis=0) + 0.5)), z])
            areas.append(len(cells) * fine**2)
    order = np.argsort(-np.array(areas), kind="stable")
    return Islands(
        np.array(places, dtype=np.float64).reshape(-1, 3)[order],
        np.array(areas, dtype=np.float64)[order],
        count,
        empty,
    )


def _loose(below: NDArray[np.bool_], mask: NDArray[np.bool_], least: int) -> list[Ints]:
    """The cells ``(K, 2)`` of each part of ``mask`` that ``below`` does not touch, if it has at
    ``least`` so many."""
    from scipy import ndimage

    labels, parts = ndimage.label(mask, np.ones((3, 3), bool))
    held = np.bincount(labels[below], minlength=parts + 1)
    size = np.bincount(labels.ravel(), minlength=parts + 1)
    loose = (held == 0) & (size >= least)
    loose[0] = False  # label 0 is the air
    return [np.argwhere(labels == part) for part in np.flatnonzero(loose).tolist()]


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells of ``mask`` and all their neighbours."""
    wide = mask.copy()
    wide[1:] |= mask[:-1]
    wide[:-1] |= mask[1:]
    grown = wide.copy()
    grown[:, 1:] |= wide[:, :-1]
    grown[:, :-1] |= wide[:, 1:]
    return grown


def sections(
    vertices: Floats, triangles: Ints, heights: Floats, pitch: float
) -> Iterator[tuple[float, NDArray[np.bool_], Floats]]:
    """For each height, the cells ``(X, Y)`` of a grid whose centre is inside,
    and the grid's origin."""
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    # The grid avoids the round numbers at which objects have corners and upright walls.
    origin = low - pitch * (1 + 0.137 * np.array([1.0, 0.71]))
    shape = np.ceil((high - origin) / pitch + 1).astype(np.int64)
    corner_z = vertices[triangles][..., 2]
    first = np.searchsorted(heights, corner_z.min(axis=1))
    last = np.searchsorted(heights, corner_z.max(axis=1))
    crossing = np.flatnonzero(last > first)
    spans = (last - first)[crossing]
    of = np.repeat(crossing, spans)
    which = np.arange(len(of)) - np.repeat(np.cumsum(spans) - spans, spans) + first[of]
    order = np.argsort(which, kind="stable")
    of, which = of[order], which[order]
    starts = np.searchsorted(which, np.arange(len(heights) + 1))
    flips = np.empty(tuple(shape), np.bool_)
    for k, z in enumerate(heights.tolist()):
        flips[:] = False
        _cross(vertices, triangles[of[starts[k] : starts[k + 1]]], z, origin, pitch, flips)
        yield z, np.logical_xor.accumulate(flips, axis=1), origin


@compiled
def _cross(vertices: Any, triangles: Any, z: float, origin: Any, pitch: float, flips: Any) -> None:
    """Mark in each row the cell from which on inside and outside change places."""
    rows, columns = flips.shape
    for t in range(len(triangles)):
        found = 0
        ax = ay = bx = by = 0.0
        for k in range(3):
            i, j = triangles[t, k], triangles[t, (k + 1) % 3]
            if i > j:  # so that both triangles at an edge give the same result
                i, j = j, i
            zi, zj = vertices[i, 2], vertices[j, 2]
            if (zi < z) == (zj < z):
                continue
            share = (z - zi) / (zj - zi)
            x = vertices[i, 0] + share * (vertices[j, 0] - vertices[i, 0])
            y = vertices[i, 1] + share * (vertices[j, 1] - vertices[i, 1])
            if found == 0:
                ax, ay = x, y
            else:
                bx, by = x, y
            found += 1
        if found != 2:
            continue
        if ax > bx:
            ax, ay, bx, by = bx, by, ax, ay
        start = max(int(np.ceil((ax - origin[0]) / pitch - 0.5)), 0)
        stop = min(int(np.ceil((bx - origin[0]) / pitch - 0.5)), rows)
        for row in range(start, stop):
            x = origin[0] + (row + 0.5) * pitch
            share = (x - ax) / (bx - ax)
            y = ay + share * (by - ay)
            column = int(np.ceil((y - origin[1]) / pitch - 0.5))
            column = min(max(column, 0), columns - 1)
            flips[row, column] ^= True
