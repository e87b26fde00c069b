"""The polyhedral mesh: cells with shared faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .geometry import fan_triangles
from .graph import components
from .polygons import Floats, Ints, PolygonMesh


@dataclass(frozen=True)
class PolyhedralMesh:
    """Cells with shared faces. The normal of a face points from its owner to its neighbour.

    Faces between two cells come first, sorted by owner and then neighbour; the owner has the
    smaller index. The faces of the surface follow in the surface's order. The vertices of the
    surface come before all other vertices, in the surface's order.
    """

    faces: PolygonMesh
    owner: Ints
    """The cell that each face's normal points away from, ``(F,)``."""
    neighbour: Ints
    """The cell on the other side of each face ``(F,)``, -1 on the boundary."""
    cell_generator: Ints
    """The generator of each cell ``(C,)``, ascending."""
    surface_vertices: int
    """The number of vertices that belong to the surface."""

    @property
    def cell_count(self) -> int:
        return len(self.cell_generator)

    @cached_property
    def half_faces(self) -> tuple[Ints, Ints, NDArray[np.bool_]]:
        """Face, cell, and reversal ``(H,)`` of each face of each cell, sorted by cell, then face.

        A face between two cells appears twice. The reversal says whether its corners must be
        reversed to be counter-clockwise seen from outside the cell.
        """
        inner = np.flatnonzero(self.neighbour >= 0)
        face = np.concatenate([np.arange(self.faces.face_count), inner])
        cell = np.concatenate([self.owner, self.neighbour[inner]])
        back = np.arange(len(face)) >= self.faces.face_count
        order = np.lexsort([face, cell])
        return face[order], cell[order], back[order]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> PolyhedralMesh:
        """The mesh of the arrays that the volume stage wrote."""
        faces, neighbour = PolygonMesh.from_arrays(arrays), arrays["face_neighbour"]
        surface = faces.select_faces(neighbour < 0).face_vertices
        count = 1 + int(surface.max(initial=-1))
        return cls(faces, arrays["face_owner"], neighbour, arrays["cell_generator"], count)

    def select_cells(self, keep: NDArray[np.bool_]) -> PolyhedralMesh:
        """The cells for which ``keep (C,)`` is true. Their faces towards other
        cells become boundary."""
        owner, beyond = keep[self.owner], (self.neighbour >= 0) & keep[self.neighbour]
        number = np.append(np.cumsum(keep) - 1, -1)
        number[:-1][~keep] = -1
        inner = self.faces.select_faces(owner & beyond)
        # Faces of the old surface come first, then the new boundary faces, turned outward.
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
        # As the class promises, vertices of the new boundary come first.
        first = np.zeros(self.faces.vertex_count, dtype=bool)
        first[corners] = True
        order = np.concatenate([np.flatnonzero(first), np.flatnonzero(~first)])
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        vertices = self.faces.vertices[order]
        return assembled(
            PolygonMesh(vertices, inner.face_offsets, place[inner.face_vertices]),
            number[self.owner[both]], number[self.neighbour[both]],
            PolygonMesh(vertices[: int(first.sum())], offsets, place[corners]),
            number[np.concatenate(sides)], self.cell_generator[keep],
        )  # fmt: skip

    def with_vertices(self, vertices: Floats) -> PolyhedralMesh:
        """The same cells with other ``vertices (V, 3)``."""
        return replace(self, faces=self.faces.with_vertices(vertices))

    @property
    def body_count(self) -> int:
        """The number of connected sets of cells."""
        inner = self.neighbour >= 0
        pairs = np.stack([self.owner[inner], self.neighbour[inner]], axis=1)
        return components(self.cell_count, pairs)[0]

    @property
    def boundary(self) -> PolygonMesh:
        """The faces that only one cell has, with all vertices."""
        return self.faces.select_faces(self.neighbour < 0)

    @cached_property
    def tetrahedra(self) -> tuple[Floats, Ints, Ints]:
        """The parts of tetrahedra that do not depend on the choice of an apex in each cell.

        Returns vertices ``(V + F', 3)``, the triangles ``(T, 3)`` of all faces of all cells, seen
        from outside, and the cell ``(T,)`` of each triangle. Faces with more than three corners
        become fans about their centroids, which are appended to the vertices.
        """
        vertices, triangles, face = fan_triangles(self.faces)
        back = np.flatnonzero(self.neighbour[face] >= 0)
        return (
            vertices,
            np.concatenate([triangles, triangles[back][:, ::-1]]),
            np.concatenate([self.owner[face], self.neighbour[face[back]]]),
        )

    def tetrahedron_volumes(self, apexes: Floats) -> Floats:
        """The volumes ``(T,)`` of the tetrahedra with ``apexes (C, 3)``, one in each cell."""
        vertices, triangles, cell = self.tetrahedra
        apex = apexes[cell]
        a, b, c = (vertices[triangles[:, k]] - apex for k in range(3))
        return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)

    def solids(self, points: Floats) -> tuple[Floats, Floats]:
        """Volume ``(C,)`` and centroid ``(C, 3)`` of each cell.

        Faces become fans about their centroids. ``points (C, 3)`` should lie near the cells:
        coordinates relative to them keep the rounding errors small.
        """
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


def _turned(mesh: PolygonMesh) -> PolygonMesh:
    """The faces with their corners in reverse order. Each begins at the same corner as before."""
    starts, face = mesh.face_offsets[:-1], mesh.corner_faces
    within = np.arange(len(face)) - starts[face]
    back = starts[face] + (mesh.valences[face] - within) % mesh.valences[face]
    return PolygonMesh(mesh.vertices, mesh.face_offsets, mesh.face_vertices[back])


def assembled(
    inner: PolygonMesh,
    owner: Ints,
    neighbour: Ints,
    surface: PolygonMesh,
    surface_owner: Ints,
    cell_generator: Ints,
) -> PolyhedralMesh:
    """The mesh of ``inner`` faces between two cells and the faces of the ``surface``.

    The two meshes number the same vertices, those of the surface first. ``owner`` and ``neighbour``
    belong to the inner faces, ``surface_owner`` to those of the surface.
    """
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
