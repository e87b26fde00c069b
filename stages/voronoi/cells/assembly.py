"""Voronoi cells as closed polyhedra with shared vertices and faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import NumericalFailure
from ...mesh.edits import reduce_rings
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.polyhedra import PolyhedralMesh, assembled
from ..diagram.cleanup import settle
from ..diagram.delaunay import Tetrahedra
from ..diagram.interface import rings_to_surface
from ..diagram.rings import voronoi_rings
from ..diagram.vertices import FLAT
from .boundary import INNER, Boundary, same_rings


def raw_cells(
    generators: Floats,
    inside: NDArray[np.bool_],
    tetrahedra: Tetrahedra,
    boundary: Boundary,
    added: int = 0,
) -> PolyhedralMesh:
    """The cells of all inside generators, bounded by ``boundary``.

    The first ``added`` of ``generators (N, 3)`` are inner ones; those of the boundary follow.
    Diagram vertices that are vertices of the surface get exactly its coordinates. Raises
    NumericalFailure if the faces at the boundary are not those of the surface.
    """

    def select(a: Ints, b: Ints) -> NDArray[np.int8]:
        a_in, b_in = inside[a], inside[b]
        sign = np.where(a_in & b_in, np.where(a < b, 1, -1), a_in.astype(int) - b_in.astype(int))
        return sign.astype(np.int8)

    rings = voronoi_rings(generators, tetrahedra, select)
    diagram = rings_to_surface(generators, tetrahedra, rings)
    raw, flat, first = diagram.mesh, diagram.flatness < FLAT, boundary.mesh.vertex_count
    at = boundary.vertex_of(diagram.tetrahedra - added, raw.vertices)
    known = at >= 0
    placed = raw.vertices.copy()
    placed[known] = boundary.mesh.vertices[at[known]]
    placed = settle(placed, raw, flat & (at == INNER))
    target = np.where(at == INNER, first + np.arange(len(at)), at)
    vertices = np.concatenate([boundary.mesh.vertices, placed])
    # Rings have numbers of diagram vertices, and after the reduction those of ``vertices``.
    wide = PolygonMesh(vertices, raw.face_offsets, raw.face_vertices)
    faces, kept = reduce_rings(wide, target)
    pairs = diagram.generators[kept]
    cell_generator = np.unique(pairs[inside[pairs]])
    cell = np.full(len(generators), -1, dtype=np.int64)
    cell[cell_generator] = np.arange(len(cell_generator))
    owner, neighbour = cell[pairs[:, 0]], cell[pairs[:, 1]]
    outer = neighbour < 0
    place = _places(pairs[outer], added + boundary.generators)
    if place is None or not same_rings(faces.select_faces(outer), place, boundary.mesh):
        raise NumericalFailure(
            "the outer faces of the cells are not those of the surface, so the inner "
            "generators changed it; lower --inner"
        )
    return assembled(
        faces.select_faces(~outer), owner[~outer], neighbour[~outer],
        boundary.mesh, owner[outer][place], cell_generator,
    )  # fmt: skip


def _places(pairs: Ints, wanted: Ints) -> Ints | None:
    """The index in ``pairs`` of each row of ``wanted (F, 2)``; None if the two sets differ."""
    base = 1 + int(max(pairs.max(initial=0), wanted.max(initial=0)))
    keys = [p @ np.array([base, 1]) for p in (pairs, wanted)]
    orders = [np.argsort(key, kind="stable") for key in keys]
    if not np.array_equal(keys[0][orders[0]], keys[1][orders[1]]):
        return None
    place = np.empty(len(wanted), dtype=np.int64)
    place[orders[1]] = orders[0]
    return place


def contracted(mesh: PolyhedralMesh, target: Ints, vertices: Floats) -> PolyhedralMesh:
    """The cells after each vertex is replaced by ``target (V,)``, an index into ``vertices``.

    Faces with fewer than three corners are removed. Vertices of the surface must be their own
    targets.
    """
    inner = mesh.neighbour >= 0
    surface = mesh.boundary.with_vertices(vertices[: mesh.surface_vertices])
    wide = PolygonMesh(vertices, mesh.faces.face_offsets, mesh.faces.face_vertices)
    faces, kept = reduce_rings(wide.select_faces(inner), target)
    return assembled(
        faces, mesh.owner[inner][kept], mesh.neighbour[inner][kept],
        surface, mesh.owner[~inner], mesh.cell_generator,
    )  # fmt: skip
