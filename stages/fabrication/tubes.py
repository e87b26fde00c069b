"""Tubes along edges: for each edge the hull of a polyhedron at either end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..surface.edits import contract_short_edges, reduce_rings
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.topology import edges


@dataclass(frozen=True)
class TubeGraph:
    """Axes of the tubes: ``nodes (K, 3)`` in mm, ``tubes (E, 2)``, and the faces over the nodes."""

    nodes: Floats
    tubes: Ints
    faces: PolygonMesh
    face_sources: Ints
    """For each face of ``faces`` the face of the surface it comes from."""


def tube_graph(surface: PolygonMesh, weld: float) -> TubeGraph:
    """The edges of ``surface (mm)`` after edges shorter than ``weld`` have been contracted.

    Voronoi edges go down to a millionth of the size: tubes along them would only cost time. A
    contracted group sits at its mean.
    """
    target = contract_short_edges(surface, weld)
    count = np.bincount(target, minlength=surface.vertex_count)
    placed = np.zeros_like(surface.vertices)
    for axis in range(3):
        placed[:, axis] = np.bincount(
            target, surface.vertices[:, axis], minlength=surface.vertex_count
        ) / np.maximum(count, 1)
    ends = np.unique(np.sort(target[edges(surface)], axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    faces, kept = reduce_rings(surface.with_vertices(placed), target)
    used = np.unique(ends)
    renumber = np.zeros(surface.vertex_count, dtype=np.int64)
    renumber[used] = np.arange(len(used))
    return TubeGraph(
        nodes=placed[used],
        tubes=renumber[ends],
        faces=PolygonMesh(placed[used], faces.face_offsets, renumber[faces.face_vertices]),
        face_sources=np.flatnonzero(kept),
    )


def ball(sides: int) -> Floats:
    """Corners of a unit-sphere polyhedron with ``sides`` around the equator, ``(P, 3)``."""
    from manifold3d import Manifold

    mesh = Manifold.sphere(1.0, sides).to_mesh()
    return np.asarray(mesh.vert_properties[:, :3], dtype=np.float64)


def compensation(corners: Floats) -> float:
    """Factor on the radius so that the thinnest tube between two polyhedra has the one asked for.

    A tube's cross-section is the polyhedron seen along the tube; its inradius is at least the
    smallest support of the polyhedron over all directions, the distance to its nearest facet.
    """
    from scipy.spatial import ConvexHull

    return float(1 / np.abs(ConvexHull(corners).equations[:, 3]).min())


def tubes(graph: TubeGraph, radius: float, sides: int) -> list[Any]:
    """One convex body per edge; neighbours share the polyhedron at their node, so they merge."""
    from manifold3d import Manifold

    corners = ball(sides)
    corners = corners * radius * compensation(corners)
    # manifold3d takes one hull at a time: this loop is over library objects, 1 ms each.
    return [
        Manifold.hull_points(np.concatenate([corners + start, corners + end]))
        for start, end in graph.nodes[graph.tubes]
    ]
