"""Clean-up of a degenerate interface: flat tetrahedra are dropped, coincident vertices merged.

Trained generators are degenerate on purpose. So many tetrahedra of their diagram are flat, and many
circumcentres coincide. Steps that would open the surface are undone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh.edits import contract_short_edges, reduce_rings
from ...mesh.graph import components
from ...mesh.polygons import PolygonMesh
from ...mesh.topology import bad_edges, edges, pinched_vertices
from .delaunay import Floats, Ints
from .interface import VoronoiSurface
from .vertices import FLAT

MERGE = 1e-6
"""Neighbouring Voronoi vertices at a smaller distance, in units of the spacing, are merged."""


@dataclass(frozen=True)
class CleanSurface:
    """A closed interface after the clean-up, and counts of the changes."""

    mesh: PolygonMesh
    generators: Ints
    dropped_flat: int
    merged_vertices: int
    dropped_faces: int
    kept_degenerate: int
    vertex_sources: Ints
    """The vertex of ``mesh`` that replaces each vertex of the raw surface, -1 if it was dropped."""


def settle(positions: Floats, mesh: PolygonMesh, flat: NDArray[np.bool_]) -> Floats:
    """Move vertices of flat tetrahedra, without usable circumcentres, to the
    mean of their neighbours."""
    if not flat.any():
        return positions
    ends = edges(mesh)
    ends = np.concatenate([ends, ends[:, ::-1]])
    known = ~flat
    settled = positions.copy()
    while not known.all():
        use = ends[known[ends[:, 1]] & ~known[ends[:, 0]]]
        if len(use) == 0:
            break
        total = np.zeros_like(settled)
        np.add.at(total, use[:, 0], settled[use[:, 1]])
        count = np.bincount(use[:, 0], minlength=len(settled))
        settled[count > 0] = total[count > 0] / count[count > 0, None]
        known = known | (count > 0)
    return settled


def clean(
    surface: VoronoiSurface,
    spacing: float,
    flat: float = FLAT,
    merge: float = MERGE,
    anchors: Floats | None = None,
    reach: float = 0.0,
) -> CleanSurface:
    """The interface without degenerate parts. It is closed if ``surface`` is.

    ``merge`` is in units of ``spacing``. If an edge would be in fewer or more than two faces, the
    vertices at it are restored, until there is no such edge. With ``anchors (A, 3)``, all vertices
    within ``reach`` of an anchor move to it and are merged. This removes thin faces between
    polygons that almost conform.
    """
    raw = surface.mesh
    near: Ints | None = None
    drawn = np.zeros(raw.vertex_count, dtype=bool)
    if anchors is not None:
        from scipy.spatial import cKDTree

        distance, near = cKDTree(anchors).query(raw.vertices)
        near = np.where(distance <= reach, near, -1).astype(np.int64)
    is_flat = surface.flatness < flat
    raw = raw.with_vertices(settle(raw.vertices, raw, is_flat))
    frozen = np.zeros(raw.vertex_count, dtype=bool)
    while True:
        dropped = is_flat & ~frozen
        identity = np.where(dropped, -1, np.arange(raw.vertex_count))
        thinned, _ = reduce_rings(raw, identity)
        if near is None:
            target = contract_short_edges(thinned, merge * spacing, ~frozen & ~dropped)
        else:
            target, drawn = _joined(raw, np.where(frozen | dropped, -1, near))
        target[dropped] = -1
        mesh, keep = reduce_rings(raw, target)
        broken = bad_edges(mesh).reshape(-1)
        if near is not None:
            broken = np.concatenate([broken, pinched_vertices(mesh)])
        if len(broken) == 0:
            break
        spoilt = np.zeros(raw.vertex_count + 1, dtype=bool)
        spoilt[broken] = True
        again = spoilt[target] & ~frozen
        lost = dropped & np.isin(np.arange(raw.vertex_count), _ring_mates(raw, spoilt[target]))
        if not (again | lost).any():
            again = ~frozen
            if not again.any():
                break
        frozen |= again | lost
    renumber = np.full(raw.vertex_count + 1, -1, dtype=np.int64)
    used = np.unique(mesh.face_vertices)
    renumber[used] = np.arange(len(used))
    moved = target >= 0
    if near is not None and anchors is not None:
        placed = mesh.vertices.copy()
        drawn &= moved
        placed[target[drawn]] = anchors[near[drawn]]
        mesh = mesh.with_vertices(placed)
    return CleanSurface(
        mesh=mesh.without_unused_vertices(),
        generators=surface.generators[keep],
        dropped_flat=int(dropped.sum()),
        merged_vertices=int((moved & (target != np.arange(raw.vertex_count))).sum()),
        dropped_faces=int((~keep).sum()),
        kept_degenerate=int(frozen.sum()),
        vertex_sources=renumber[target],
    )


def _joined(mesh: PolygonMesh, group: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """For each vertex the one that replaces it, and whether it is merged, ``(V,)`` each.

    Of the vertices of one ``group (V,)``, those in its largest set that is connected by edges are
    merged into the first of them.
    """
    count = mesh.vertex_count
    ends = edges(mesh)
    ends = ends[(group[ends[:, 0]] == group[ends[:, 1]]) & (group[ends[:, 0]] >= 0)]
    parts, part = components(count, ends)
    size = np.bincount(part, minlength=parts)
    first = np.full(parts, count, dtype=np.int64)
    np.minimum.at(first, part, np.arange(count))
    largest = np.zeros(int(group.max(initial=0)) + 1, dtype=np.int64)
    np.maximum.at(largest, group[group >= 0], size[part[group >= 0]])
    chosen = (group >= 0) & (size[part] == largest[np.maximum(group, 0)])
    return np.where(chosen, first[part], np.arange(count)), chosen


def _ring_mates(mesh: PolygonMesh, marked: NDArray[np.bool_]) -> Ints:
    """The vertices that share a face with a marked vertex."""
    touched = np.zeros(mesh.face_count, dtype=bool)
    touched[mesh.corner_faces[marked[mesh.face_vertices]]] = True
    return np.unique(mesh.face_vertices[touched[mesh.corner_faces]])
