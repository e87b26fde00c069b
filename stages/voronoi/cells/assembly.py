"""Voronoi cells as closed polyhedra with shared vertices and faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import NumericalFailure
from ...mesh.edits import reduce_rings
from ...mesh.geometry import fan_triangles
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ..diagram.cleanup import settle
from ..diagram.delaunay import Tetrahedra
from ..diagram.interface import rings_to_surface
from ..diagram.rings import voronoi_rings
from ..diagram.vertices import FLAT
from .boundary import INNER, Boundary, same_rings


@dataclass(frozen=True)
class PolyhedralMesh:
    """Cells with shared faces; a face's normal points from its owner to its neighbour.

    Faces between two cells come first, sorted by owner and neighbour (owner the smaller); then
    those of the surface in its order. The surface's vertices are the first ones, in its order.
    """

    faces: PolygonMesh
    owner: Ints
    """Cell that each face's normal points away from, ``(F,)``."""
    neighbour: Ints
    """Cell on the other side ``(F,)``, -1 on the boundary."""
    cell_generator: Ints
    """Generator of each cell ``(C,)``, ascending."""
    surface_vertices: int
    """Number of vertices that are vertices of the surface."""

    @property
    def cell_count(self) -> int:
        return len(self.cell_generator)

    @cached_property
    def half_faces(self) -> tuple[Ints, Ints, NDArray[np.bool_]]:
        """Each face once for each of its cells: face, cell, and whether its corners must be
        reversed to be counter-clockwise from outside the cell. Sorted by cell, then face."""
        inner = np.flatnonzero(self.neighbour >= 0)
        face = np.concatenate([np.arange(self.faces.face_count), inner])
        cell = np.concatenate([self.owner, self.neighbour[inner]])
        back = np.arange(len(face)) >= self.faces.face_count
        order = np.lexsort([face, cell])
        return face[order], cell[order], back[order]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> PolyhedralMesh:
        """The cells that stage volume wrote."""
        faces, neighbour = PolygonMesh.from_arrays(arrays), arrays["face_neighbour"]
        surface = faces.select_faces(neighbour < 0).face_vertices
        count = 1 + int(surface.max(initial=-1))
        return cls(faces, arrays["face_owner"], neighbour, arrays["cell_generator"], count)

    def select_cells(self, keep: NDArray[np.bool_]) -> PolyhedralMesh:
        """The cells for which ``keep (C,)`` is true; faces towards others become boundary."""
        owner, beyond = keep[self.owner], (self.neighbour >= 0) & keep[self.neighbour]
        number = np.append(np.cumsum(keep) - 1, -1)
        number[:-1][~keep] = -1
        inner = self.faces.select_faces(owner & beyond)
        # The surface's own faces come first, then the faces of the cut, turned outward.
        parts = [
            self.faces.select_faces(owner & (self.neighbour < 0)),
            self.faces.select_faces(owner & (self.neighbour >= 0) & ~beyond),
            _turned(self.faces.select_faces(~owner & beyond)),
        ]
        sides = [
            self.owner[owner & (self.neighbour < 0)],
            self.owner[owner & (self.neighbour >= 0) & ~beyond],
            self.neighbour[~owner & beyond],
        ]
        both = owner & beyond
        corners = np.concatenate([part.face_vertices for part in parts])
        sizes = np.concatenate([part.valences for part in parts])
        # Vertices of the new boundary come first, in their order.
        first = np.zeros(self.faces.vertex_count, dtype=bool)
        first[corners] = True
        order = np.concatenate([np.flatnonzero(first), np.flatnonzero(~first)])
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        vertices = self.faces.vertices[order]
        return _assembled(
            PolygonMesh(vertices, inner.face_offsets, place[inner.face_vertices]),
            number[self.owner[both]], number[self.neighbour[both]],
            PolygonMesh(vertices[: int(first.sum())], offsets, place[corners]),
            number[np.concatenate(sides)], self.cell_generator[keep],
        )  # fmt: skip

    def with_vertices(self, vertices: Floats) -> PolyhedralMesh:
        """The same cells over other positions ``(V, 3)``."""
        return replace(self, faces=self.faces.with_vertices(vertices))

    @property
    def body_count(self) -> int:
        """Sets of cells that no faces connect."""
        inner = self.neighbour >= 0
        pairs = np.stack([self.owner[inner], self.neighbour[inner]], axis=1)
        return components(self.cell_count, pairs)[0]

    @property
    def boundary(self) -> PolygonMesh:
        """The faces of one cell only, over all vertices."""
        return self.faces.select_faces(self.neighbour < 0)

    @cached_property
    def tetrahedra(self) -> tuple[Floats, Ints, Ints]:
        """Vertices ``(V + F', 3)``, triangles ``(T, 3)`` of all faces seen from outside of a cell,
        and the cell ``(T,)`` of each: with a point of the cell each gives a tetrahedron.

        Faces with more than three corners are fanned about their centroids, which are appended to
        the vertices.
        """
        vertices, triangles, face = fan_triangles(self.faces)
        back = np.flatnonzero(self.neighbour[face] >= 0)
        return (
            vertices,
            np.concatenate([triangles, triangles[back][:, ::-1]]),
            np.concatenate([self.owner[face], self.neighbour[face[back]]]),
        )

    def tetrahedron_volumes(self, apexes: Floats) -> Floats:
        """Volumes of the tetrahedra from ``apexes (C, 3)``, a point of each cell, to its
        triangles."""
        vertices, triangles, cell = self.tetrahedra
        apex = apexes[cell]
        a, b, c = (vertices[triangles[:, k]] - apex for k in range(3))
        return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)

    def solids(self, points: Floats) -> tuple[Floats, Floats]:
        """Volume ``(C,)`` and centroid ``(C, 3)`` of each cell, its faces fanned about their
        centroids. ``points (C, 3)`` are near the cells, to keep the sums small."""
        vertices, triangles, cell = self.tetrahedra
        each = self.tetrahedron_volumes(points)
        volume = np.bincount(cell, each, minlength=self.cell_count).astype(np.float64)
        arm = vertices[triangles].sum(axis=1) - 3 * points[cell]
        moment = np.stack(
            [np.bincount(cell, each * arm[:, k] / 4, minlength=self.cell_count) for k in range(3)],
            axis=1,
        )
        solid = np.where(volume > 0, volume, 1.0)[:, None]
        return volume, points + np.where(volume[:, None] > 0, moment / solid, 0.0)


def raw_cells(
    generators: Floats,
    inside: NDArray[np.bool_],
    tetrahedra: Tetrahedra,
    boundary: Boundary,
    added: int = 0,
) -> PolyhedralMesh:
    """The cells of all inside generators ``(N, 3)`` of a diagram, bounded by ``boundary``, whose
    generators come after the first ``added`` ones.

    Diagram vertices that are the surface's become the surface's own, to the bit. Raises
    NumericalFailure when the faces at the boundary are not those of the surface.
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
    # Ring numbers are of diagram vertices; the reduced rings are over ``vertices``.
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
    return _assembled(
        faces.select_faces(~outer), owner[~outer], neighbour[~outer],
        boundary.mesh, owner[outer][place], cell_generator,
    )  # fmt: skip


def _turned(mesh: PolygonMesh) -> PolygonMesh:
    """The faces in reverse order of their corners, each beginning at the same corner."""
    starts, face = mesh.face_offsets[:-1], mesh.corner_faces
    within = np.arange(len(face)) - starts[face]
    back = starts[face] + (mesh.valences[face] - within) % mesh.valences[face]
    return PolygonMesh(mesh.vertices, mesh.face_offsets, mesh.face_vertices[back])


def _places(pairs: Ints, wanted: Ints) -> Ints | None:
    """The place of each row of ``wanted (F, 2)`` in ``pairs``; None if the rows are not the
    same."""
    base = 1 + int(max(pairs.max(initial=0), wanted.max(initial=0)))
    keys = [p @ np.array([base, 1]) for p in (pairs, wanted)]
    orders = [np.argsort(key, kind="stable") for key in keys]
    if not np.array_equal(keys[0][orders[0]], keys[1][orders[1]]):
        return None
    place = np.empty(len(wanted), dtype=np.int64)
    place[orders[1]] = orders[0]
    return place


def _assembled(
    inner: PolygonMesh,
    owner: Ints,
    neighbour: Ints,
    surface: PolygonMesh,
    surface_owner: Ints,
    cell_generator: Ints,
) -> PolyhedralMesh:
    order = np.lexsort([neighbour, owner])
    starts, length = inner.face_offsets[:-1][order], inner.valences[order]
    offsets = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    take = np.arange(offsets[-1]) + np.repeat(starts - offsets[:-1], length)
    corners = np.concatenate([inner.face_vertices[take], surface.face_vertices])
    used = np.zeros(inner.vertex_count, dtype=bool)
    used[: surface.vertex_count] = True
    used[corners] = True
    number = np.cumsum(used) - 1
    faces = PolygonMesh(
        inner.vertices[used],
        np.concatenate([offsets, offsets[-1] + surface.face_offsets[1:]]),
        number[corners],
    )
    outside = np.full(surface.face_count, -1, dtype=np.int64)
    return PolyhedralMesh(
        faces,
        np.concatenate([owner[order], surface_owner]),
        np.concatenate([neighbour[order], outside]),
        cell_generator,
        surface.vertex_count,
    )


def contracted(mesh: PolyhedralMesh, target: Ints, vertices: Floats) -> PolyhedralMesh:
    """The cells after vertices became ``target (V,)``, given as numbers of ``vertices``; faces with
    less than three corners are removed. The surface's vertices must stay as they are."""
    inner = mesh.neighbour >= 0
    surface = mesh.boundary.with_vertices(vertices[: mesh.surface_vertices])
    wide = PolygonMesh(vertices, mesh.faces.face_offsets, mesh.faces.face_vertices)
    faces, kept = reduce_rings(wide.select_faces(inner), target)
    return _assembled(
        faces, mesh.owner[inner][kept], mesh.neighbour[inner][kept],
        surface, mesh.owner[~inner], mesh.cell_generator,
    )  # fmt: skip
