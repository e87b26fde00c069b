"""Flat caps over the openings of a mesh, as at the ends of a wing or under a bust."""

from __future__ import annotations

import numpy as np

from ...mesh.geometry import (
    component_volumes,
    enclosed_volume,
    face_frames,
    fan_triangles,
    triangle_normals,
)
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.topology import OPEN, bad_edges, edge_faults, face_components
from ...mesh.triangulation import EXACT, loop_polygons, triangulated
from .crossing_child import uncrossed
from .united import manifold

SHARE = 0.3
"""Largest area of the caps, over that of the mesh: with larger ones it is a sheet or a bowl."""
LEVEL, FACING = 1e-3, 1e-3
"""Within what distance, over the extent, and one less what cosine two openings are in a plane."""
SPECK = 1e-4
"""Volume, over that of the largest part, below which what a cap cuts off is left out."""


def capped(mesh: PolygonMesh) -> tuple[PolygonMesh, int] | None:
    """The triangles of ``mesh`` with flat caps over all of its openings, and how many these are.

    None where edges are bad otherwise, an opening is not flat or touches another, the caps would
    be large beside the mesh, or cross it so that no solid can be made of both.
    """
    vertices, triangles = fan_triangles(mesh)[:2]
    loops = _openings(PolygonMesh.of_triangles(vertices, triangles))
    if not loops:
        return None
    caps = _caps(vertices, loops)
    if caps is None:
        return None
    own, added = (triangle_normals(vertices, part)[1].sum() for part in (triangles, caps))
    if added > SHARE * own:
        return None
    closed = np.concatenate([triangles, caps])
    result = PolygonMesh.of_triangles(vertices, closed)
    from ...mesh.queries.intersections import self_intersections  # what it compiles with is large

    if len(bad_edges(result)) or (self_intersections(vertices, closed) >= len(triangles)).any():
        solid = _resolved(result)
        return None if solid is None else (solid, len(loops))
    return result, len(loops)


def _resolved(mesh: PolygonMesh) -> PolygonMesh | None:
    """What ``mesh``, whose caps touch or cross it, encloses, without the specks between both; None
    where that fails."""
    if enclosed_volume(*fan_triangles(mesh)[:2]) < 0:
        mesh = PolygonMesh.of_triangles(mesh.vertices, mesh.face_vertices.reshape(-1, 3)[:, ::-1])
    solid = manifold(uncrossed(mesh))
    if solid is None:
        return None
    count, part = face_components(solid)
    volume = np.abs(component_volumes(solid, part, count))
    kept = solid.face_vertices.reshape(-1, 3)[(volume > SPECK * volume.max())[part]]
    return PolygonMesh.of_triangles(solid.vertices, kept).without_unused_vertices()


def _openings(mesh: PolygonMesh) -> list[Ints]:
    """The vertices around each opening, the way that a face which closes it goes; none at all where
    an edge is bad otherwise or two openings share a vertex."""
    if (edge_faults(mesh)[1] > OPEN).any():
        return []
    start, end = mesh.face_vertices, mesh.next_vertices
    span = mesh.vertex_count
    alone = ~np.isin(start * span + end, end * span + start)
    after = np.full(span, -1)
    after[end[alone]] = start[alone]
    if len(np.unique(end[alone])) < alone.sum():
        return []
    left = after >= 0
    loops = []
    for first in np.flatnonzero(left):
        if not left[first]:
            continue
        loop = [int(first)]
        while after[loop[-1]] != first:
            loop.append(int(after[loop[-1]]))
        left[loop] = False
        loops.append(np.array(loop))
    return loops


def _caps(vertices: Floats, loops: list[Ints]) -> Ints | None:
    """Triangles that close the ``loops``; those in one plane are closed together, since one may be
    the inner edge of another's ring."""
    size, normal, centre = face_frames(loop_polygons(vertices, loops))
    extent = np.array([np.ptp(vertices[loop], axis=0).max() for loop in loops])
    if (size <= EXACT * extent**2).any():
        return None
    left, found = np.ones(len(loops), dtype=bool), []
    for number in np.argsort(-size, kind="stable"):
        if not left[number]:
            continue
        height = np.abs((centre - centre[number]) @ normal[number])
        level = (height < LEVEL * extent[number]) & (np.abs(normal @ normal[number]) > 1 - FACING)
        group = [number, *np.flatnonzero(level & left & (np.arange(len(loops)) != number))]
        cap = triangulated(vertices, [loops[k] for k in group], normal[number])
        if cap is None:
            group = [number]
            cap = triangulated(vertices, [loops[number]], normal[number])
        if cap is None:
            return None
        left[group] = False
        found.append(cap)
    return np.concatenate(found)
