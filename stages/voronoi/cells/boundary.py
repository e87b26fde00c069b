"""The surface at which cells end, and the diagram vertices that are vertices of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh.polygons import Floats, Ints, PolygonMesh
from ..diagram.cleanup import CleanSurface
from ..diagram.interface import VoronoiSurface

INNER, DROPPED = -1, -2


@dataclass(frozen=True)
class Boundary:
    """The surface at which cells end, with the inside and the outside generator of each face.

    ``vertex_of(tetrahedra (T, 4), centres (T, 3))`` gives the surface vertex at each circumcentre.
    It gives INNER if there is none, and DROPPED if the clean-up removed the vertex. Generators have
    their number among those of the surface; inner generators have negative numbers.
    """

    mesh: PolygonMesh
    generators: Ints
    vertex_of: Callable[[Ints, Floats], Ints]

    @classmethod
    def certified(cls, trained: PolygonMesh) -> Boundary:
        """The boundary of F trained faces that conform. Face f has the generators f and F + f.

        All generators of the faces at a vertex lie on its sphere, and no others do. So a
        tetrahedron has its circumcentre at a vertex if its generators belong to faces at that
        vertex. The four generators of two faces with a common edge are coplanar; such a flat
        tetrahedron may represent either end of the edge.
        """
        count = trained.face_count
        number = np.arange(count)
        keys = np.sort(trained.corner_faces * trained.vertex_count + trained.face_vertices)

        def vertex_of(tetrahedra: Ints, centres: Floats) -> Ints:
            result = np.full(len(tetrahedra), INNER, dtype=np.int64)
            own = np.flatnonzero((tetrahedra >= 0).all(axis=1))
            face = tetrahedra[own] % count
            size = trained.valences[face[:, 0]]
            row = np.repeat(np.arange(len(face)), size)
            within = np.arange(len(row)) - np.repeat(np.cumsum(size) - size, size)
            vertex = trained.face_vertices[trained.face_offsets[face[row, 0]] + within]
            common = np.ones(len(row), dtype=bool)
            for column in (1, 2, 3):
                wanted = face[row, column] * trained.vertex_count + vertex
                place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
                common &= keys[place] == wanted
            result[own[row[common]]] = vertex[common]
            return result

        return cls(trained, np.stack([number, count + number], axis=1), vertex_of)

    @classmethod
    def cleaned(
        cls,
        raw: VoronoiSurface,
        inside: NDArray[np.bool_],
        cleaned: CleanSurface,
        mesh: PolygonMesh,
        within: float,
    ) -> Boundary | None:
        """The boundary ``mesh`` that was written after the clean-up of the interface ``raw``.

        ``inside (N,)`` has the labels of the generators. Tetrahedra are recognised by their
        generators. Generators on one sphere may be divided into tetrahedra in another way; these
        are recognised by their circumcentres, and flat ones may appear or disappear. Returns None
        if vertices or faces differ by more than ``within``.
        """
        from scipy.spatial import cKDTree

        if (cleaned.mesh.vertex_count, cleaned.mesh.face_count) != (
            mesh.vertex_count, mesh.face_count,
        ):  # fmt: skip
            return None
        number = np.arange(mesh.vertex_count)
        if (np.linalg.norm(cleaned.mesh.vertices - mesh.vertices, axis=1) > within).any():
            distance, number = cKDTree(mesh.vertices).query(cleaned.mesh.vertices)
            if distance.max() > within or len(np.unique(number)) < len(number):
                return None
        generators = _matched(cleaned, number, mesh)
        if generators is None:
            return None
        known, tree = _rows(raw.tetrahedra), cKDTree(raw.mesh.vertices)
        order = np.argsort(known)
        gone = cleaned.vertex_sources < 0
        sources = np.where(gone, DROPPED, number[np.maximum(cleaned.vertex_sources, 0)])

        def vertex_of(tetrahedra: Ints, centres: Floats) -> Ints:
            result = np.full(len(tetrahedra), INNER, dtype=np.int64)
            # Inner generators have negative numbers.
            labels = inside[np.maximum(tetrahedra, 0)] | (tetrahedra < 0)
            mixed = np.flatnonzero(~labels.all(axis=1))
            wanted = _rows(tetrahedra[mixed])
            place = order[np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)]
            there = known[place] == wanted
            result[mixed[there]] = sources[place[there]]
            rest = mixed[~there]
            distance, near = tree.query(centres[rest])
            result[rest] = np.where(distance <= within, sources[near], DROPPED)
            return result

        return cls(mesh, generators, vertex_of)


def _matched(cleaned: CleanSurface, number: Ints, mesh: PolygonMesh) -> Ints | None:
    """The generators of each face of ``mesh``; None if its faces are not those of ``cleaned``.

    ``number (V,)`` gives the vertex of ``mesh`` for each vertex of ``cleaned``.
    """
    ours = PolygonMesh(mesh.vertices, cleaned.mesh.face_offsets, number[cleaned.mesh.face_vertices])
    orders = []
    for one in (ours, mesh):
        corners = from_least(one)
        starts, size = one.face_offsets[:-1], one.valences
        # In a closed surface, the first two corners and the last one identify a face.
        orders.append(
            np.lexsort([corners[starts + size - 1], corners[starts + 1], corners[starts]])
        )
    generators = np.empty_like(cleaned.generators)
    generators[orders[1]] = cleaned.generators[orders[0]]
    place = np.empty(len(orders[0]), dtype=np.int64)
    place[orders[1]] = orders[0]
    return generators if same_rings(ours, place, mesh) else None


def from_least(mesh: PolygonMesh) -> Ints:
    """The corners of each face, beginning with the smallest index."""
    order = np.lexsort([mesh.face_vertices, mesh.corner_faces])
    starts, face = mesh.face_offsets[:-1], mesh.corner_faces
    turn = (order[starts] - starts)[face]
    within = np.arange(len(face)) - starts[face]
    return np.asarray(mesh.face_vertices[starts[face] + (within + turn) % mesh.valences[face]])


def same_rings(first: PolygonMesh, place: Ints, second: PolygonMesh) -> bool:
    """Whether face ``place[f]`` of ``first`` has the same corners as face f of ``second``, in
    the same cyclic order."""
    size = second.valences
    if not np.array_equal(first.valences[place], size):
        return False
    shift = np.repeat(first.face_offsets[place] - second.face_offsets[:-1], size)
    taken = from_least(first)[np.arange(len(shift)) + shift]
    return bool(np.array_equal(taken, from_least(second)))


def _rows(tetrahedra: Ints) -> NDArray[np.void]:
    """One comparable value for each tetrahedron."""
    return np.ascontiguousarray(np.sort(tetrahedra, axis=1)).view([("", np.int64)] * 4).reshape(-1)
