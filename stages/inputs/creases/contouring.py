"""Dual contouring of a field (Ju et al. 2002): triangles that keep the creases of its zero set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...mesh.geometry import triangle_normals
from ...mesh.polygons import Floats, Ints

if TYPE_CHECKING:
    from ...mesh.model_frame import ModelFrame
    from ..field.source import FieldSource

STEP = 0.4
"""Edge of a cell, in units of h0."""
AROUND = 2
"""Cells beyond the bounding box."""
BISECTIONS = 20
FLAT = 0.05
"""Eigenvalues of the planes of a cell below this share of the largest give no direction."""


@dataclass(frozen=True)
class Crossings:
    """Where a surface crosses the edges of a grid."""

    cell: Ints
    """The four cells around each edge ``(N, 4)``."""
    quad: Ints
    """The same, in the order in which their vertices make a face that looks outward."""
    at: Floats
    normal: Floats
    """Points and unit normals, ``(N, 3)`` both."""


def contoured(source: FieldSource, frame: ModelFrame) -> tuple[Floats, Ints]:
    """Vertices in model units and triangles, facing outward, of the zero set of ``source``."""
    box = frame.model_from_input(np.asarray(source.bounding_box(), dtype=float))

    def crossed(start: Floats, way: Floats) -> tuple[Floats, Floats]:
        at = _crossing(source, frame, start, way)
        _, slope = source.gradient(frame.input_from_model(at))
        return at, slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)

    inside = partial(_inside, source, frame)
    return triangulated(crossings(inside, crossed, box, STEP), STEP)


def crossings(
    inside: Callable[[Floats], NDArray[np.bool_]],
    crossed: Callable[[Floats, Floats], tuple[Floats, Floats]],
    box: Floats,
    step: float,
) -> Crossings:
    """The crossings of the surface in ``box (2, 3)`` with a grid of edges ``step`` long.

    ``inside`` says of points whether they are, ``crossed(start, way)`` where the surface crosses
    the ways from ``start``, and its normals there.
    """
    low = box.min(axis=0) - AROUND * step
    size = np.ceil((box.max(axis=0) - low) / step).astype(int) + AROUND + 1
    index = np.stack(np.meshgrid(*(np.arange(s) for s in size), indexing="ij"), axis=-1)
    # Off the lattice that the shape itself may lie on.
    origin = low - step * np.array([0.317, 0.211, 0.123])
    within = inside(origin + step * index.reshape(-1, 3)).reshape(size)
    quads, cells, starts, ways = [], [], [], []
    strides = np.array([size[1] * size[2], size[2], 1])
    for axis in range(3):
        here = np.moveaxis(within, axis, 0)
        start = np.stack(np.nonzero(here[:-1] != here[1:]), axis=1)
        start = np.insert(start[:, 1:], axis, start[:, 0], axis=1)
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        around = np.stack([start, start - u, start - u - v, start - v], axis=1) @ strides
        leaving = within[tuple(start.T)]
        quads.append(np.where(leaving[:, None], around, around[:, ::-1]))
        cells.append(around)
        starts.append(origin + step * start)
        ways.append(np.broadcast_to(np.eye(3)[axis] * step, start.shape))
    at, normal = crossed(np.concatenate(starts), np.concatenate(ways))
    return Crossings(np.concatenate(cells), np.concatenate(quads), at, normal)


def triangulated(found: Crossings, step: float) -> tuple[Floats, Ints]:
    """Vertices, one in each cell, and triangles between those of the cells around an edge."""
    used, number = np.unique(found.cell.reshape(-1), return_inverse=True)
    places = _vertices(
        number.reshape(-1), np.repeat(found.at, 4, axis=0), np.repeat(found.normal, 4, axis=0), step
    )
    return places, _halved(places, np.searchsorted(used, found.quad), found.normal)


def _inside(source: FieldSource, frame: ModelFrame, points: Floats) -> NDArray[np.bool_]:
    return _values(source, frame, points) < 0


def _values(source: FieldSource, frame: ModelFrame, points: Floats) -> Floats:
    return np.concatenate(
        [source.value(frame.input_from_model(part))
         for part in np.array_split(points, max(1, len(points) // 500_000))]
    )  # fmt: skip


def _crossing(source: FieldSource, frame: ModelFrame, start: Floats, way: Floats) -> Floats:
    """Where the field changes its sign between ``start`` and ``start + way``."""
    low, high = np.zeros(len(start)), np.ones(len(start))
    first = _values(source, frame, start) < 0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        same = (_values(source, frame, start + middle[:, None] * way) < 0) == first
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.asarray(start + (0.5 * (low + high))[:, None] * way)


def _vertices(cell: Ints, at: Floats, normal: Floats, step: float) -> Floats:
    """For each cell the point nearest to the planes through its crossings, ``(C, 3)``."""
    count = int(cell.max()) + 1
    many = np.bincount(cell, minlength=count)
    mean = np.stack([np.bincount(cell, at[:, k]) for k in range(3)], 1) / many[:, None]
    height = np.einsum("ij,ij->i", normal, at - mean[cell])
    square, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for i in range(3):
        right[:, i] = np.bincount(cell, normal[:, i] * height, minlength=count)
        for j in range(3):
            square[:, i, j] = np.bincount(cell, normal[:, i] * normal[:, j], minlength=count)
    value, vector = np.linalg.eigh(square)
    keep = value > FLAT * value[:, -1:]
    along = np.einsum("cij,ci->cj", vector, right)
    along = np.where(keep, along / np.where(keep, value, 1.0), 0.0)
    move = np.einsum("cij,cj->ci", vector, along)
    length = np.linalg.norm(move, axis=1, keepdims=True)
    return np.asarray(mean + move * np.minimum(1.0, step / np.maximum(length, 1e-300)))


def _halved(places: Floats, quad: Ints, normal: Floats) -> Ints:
    """Triangles of quadrilaterals, along the diagonal whose halves face most as ``normal`` does."""
    ways = []
    for turn in range(2):
        a, b, c, d = np.roll(quad, -turn, axis=1).T
        ways.append((np.stack([a, b, c], 1), np.stack([a, c, d], 1)))
    worst = [
        np.minimum(*(
            np.einsum("ij,ij->i", triangle_normals(places, half)[0], normal) for half in halves
        ))
        for halves in ways
    ]  # fmt: skip
    first = (worst[0] >= worst[1])[:, None]
    halves = [np.where(first, one, other) for one, other in zip(*ways, strict=True)]
    triangles = np.concatenate(halves)
    flat = (triangles == triangles[:, [1, 2, 0]]).any(axis=1)
    return np.asarray(triangles[~flat])
