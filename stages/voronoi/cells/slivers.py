"""Removal of short edges and small faces inside a polyhedral mesh, where cells stay sound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh.geometry import face_frames
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.polyhedra import PolyhedralMesh
from ...mesh.topology import edges
from .assembly import contracted
from .checks import cell_faults

PASSES = 12
"""Largest number of passes over all edges."""
LESS, ATTEMPTS = 0.2, 12
"""Where a cell would become faulty, the tolerance is multiplied by the first number, at most as
often as the second says."""


@dataclass(frozen=True)
class Merged:
    """Cells without most of the short edges and small faces."""

    mesh: PolyhedralMesh
    contracted_vertices: int
    spared_vertices: int
    """Number of vertices with a lower tolerance, because one of their cells
    would have become faulty."""
    faults: dict[str, int]
    """Number of cells that fail each check."""


def merged(mesh: PolyhedralMesh, tolerance: float, points: Floats) -> Merged:
    """Contract edges shorter than ``tolerance`` times the size of the smallest cell at them.

    The shortest edge of a face is contracted too if the face is smaller than the square of that
    length. Vertices of the surface do not move. Where a cell would fail a check, the tolerance is
    lowered until it does not. ``points (C, 3)`` lie near the cells, which keeps rounding errors
    small.
    """
    least = tolerance * _vertex_sizes(mesh, np.cbrt(np.maximum(mesh.solids(points)[0], 0)))
    spared = np.zeros(mesh.faces.vertex_count, dtype=bool)
    for attempt in range(ATTEMPTS + 1):
        target, vertices = _targets(mesh, least.copy())
        found = contracted(mesh, target, vertices)
        faults = cell_faults(found, points)
        moved = np.bincount(target, minlength=len(target))[target] > 1
        again = _touched(mesh, np.any(list(faults.values()), axis=0)) & moved
        if not again.any():
            break
        spared |= again
        least[again] *= LESS if attempt < ATTEMPTS - 1 else 0.0
    return Merged(
        found,
        int((target != np.arange(len(target))).sum()),
        int(spared.sum()),
        {name: int(cells.sum()) for name, cells in faults.items()},
    )


def _vertex_sizes(mesh: PolyhedralMesh, cell_size: Floats) -> Floats:
    """The size of the smallest cell at each vertex."""
    face_size = cell_size[mesh.owner]
    inner = mesh.neighbour >= 0
    face_size[inner] = np.minimum(face_size[inner], cell_size[mesh.neighbour[inner]])
    size = np.full(mesh.faces.vertex_count, np.inf)
    np.minimum.at(size, mesh.faces.face_vertices, face_size[mesh.faces.corner_faces])
    return size


def _touched(mesh: PolyhedralMesh, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each vertex belongs to one of the marked ``cells (C,)``."""
    face = cells[mesh.owner] | ((mesh.neighbour >= 0) & cells[mesh.neighbour])
    vertices = np.zeros(mesh.faces.vertex_count, dtype=bool)
    vertices[mesh.faces.face_vertices[face[mesh.faces.corner_faces]]] = True
    return vertices


def _targets(mesh: PolyhedralMesh, least: Floats) -> tuple[Ints, Floats]:
    """The vertex that replaces each vertex, and the new positions.

    ``least (V,)`` is the shortest edge that is allowed at each vertex. In one pass a vertex moves
    to the nearest vertex at the other end of a short edge, so that two vertices of the surface are
    never merged.
    """
    count, fixed = mesh.faces.vertex_count, mesh.surface_vertices
    target, vertices = np.arange(count), mesh.faces.vertices.copy()
    weight = np.ones(count)
    now = mesh.faces
    for _ in range(PASSES):
        ends = edges(now)
        length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
        wanted = np.minimum(least[ends[:, 0]], least[ends[:, 1]])
        short = length < wanted
        short |= _of_small_faces(now, ends, length, least)
        start, end = np.concatenate([ends[short], ends[short][:, ::-1]]).T
        free = (start >= fixed) & (least[start] > 0) & (least[end] > 0)
        if not free.any():
            break
        start, end, far = start[free], end[free], np.tile(length[short], 2)[free]
        order = np.lexsort([end, far, start])
        first = order[np.flatnonzero(np.diff(start[order], prepend=-1))]
        groups, group = components(count, np.stack([start[first], end[first]], axis=1))
        # Vertices of the surface have the smallest indices, so that they are chosen first.
        chosen = np.full(groups, count, dtype=np.int64)
        np.minimum.at(chosen, group, np.arange(count))
        step = chosen[group]
        total = np.bincount(step, weight, minlength=count).astype(np.float64)
        mean = (
            np.stack(
                [np.bincount(step, weight * vertices[:, k], minlength=count) for k in range(3)],
                axis=1,
            )
            / np.maximum(total, 1)[:, None]
        )
        changed = np.bincount(step, minlength=count) > 1
        changed[:fixed] = False
        vertices[changed] = mean[changed]
        weight = total
        np.minimum.at(least, step, least)
        target = step[target]
        now = _over(now, vertices, step)
    return target, vertices


def _over(mesh: PolygonMesh, vertices: Floats, target: Ints) -> PolygonMesh:
    from ...mesh.edits import reduce_rings

    return reduce_rings(mesh.with_vertices(vertices), target)[0]


def _of_small_faces(
    mesh: PolygonMesh, ends: Ints, length: Floats, least: Floats
) -> NDArray[np.bool_]:
    """The shortest edge of each face whose area is less than the square of ``least``."""
    area = face_frames(mesh)[0]
    wanted = np.full(mesh.face_count, np.inf)
    np.minimum.at(wanted, mesh.corner_faces, least[mesh.face_vertices])
    small = area < wanted**2
    result = np.zeros(len(ends), dtype=bool)
    corner = np.flatnonzero(small[mesh.corner_faces])
    if len(corner) == 0:
        return result
    a, b = mesh.face_vertices[corner], mesh.next_vertices[corner]
    key = np.minimum(a, b) * mesh.vertex_count + np.maximum(a, b)
    edge = np.searchsorted(ends @ np.array([mesh.vertex_count, 1]), key)
    face = mesh.corner_faces[corner]
    order = np.lexsort([length[edge], face])
    first = np.flatnonzero(np.diff(face[order], prepend=-1))
    result[edge[order[first]]] = True
    return result
