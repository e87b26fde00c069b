"""Which vertices of a diagram are vertices of the written surface."""

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
    """The surface that cells are to end at, and the inside and the outside generator of its faces.

    ``vertex_of(tetrahedra (T, 4), centres (T, 3))`` gives the surface's vertex at the circumcentre
    of each, INNER where there is none, DROPPED where the surface was cleaned of it. Generators are
    numbered among those of the surface; a negative number is one that was added inside.
    """

    mesh: PolygonMesh
    generators: Ints
    vertex_of: Callable[[Ints, Floats], Ints]

    @classmethod
    def certified(cls, trained: PolygonMesh) -> Boundary:
        """The boundary of trained faces that conform; face f of F has the generators f (inside) and
        F + f.

        All generators of a vertex's faces lie on its sphere and no others do. So a tetrahedron
        whose generators belong to faces around one vertex has its circumcentre there. Tetrahedra of
        the two faces at an edge are flat, and stand for either of its ends.
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
        """The boundary ``mesh`` as written, which the clean-up made of the interface ``raw`` of
        generators that are ``inside (N,)``; None if vertices or faces differ by more than
        ``within``.

        Tetrahedra are recognised by their generators. Where generators on one sphere are divided
        into other tetrahedra, they are recognised by their centre; flat ones may appear or
        disappear.
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
            # Generators that were added inside have a negative number.
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
    """The generators of each face of ``mesh``, which has the rings of ``cleaned`` over vertices
    that there have the ``number (V,)``; None if it has others."""
    ours = PolygonMesh(mesh.vertices, cleaned.mesh.face_offsets, number[cleaned.mesh.face_vertices])
    orders = []
    for one in (ours, mesh):
        corners = from_least(one)
        starts, size = one.face_offsets[:-1], one.valences
        # The first two corners and the last name a face of a closed surface.
        orders.append(
            np.lexsort([corners[starts + size - 1], corners[starts + 1], corners[starts]])
        )
    generators = np.empty_like(cleaned.generators)
    generators[orders[1]] = cleaned.generators[orders[0]]
    place = np.empty(len(orders[0]), dtype=np.int64)
    place[orders[1]] = orders[0]
    return generators if same_rings(ours, place, mesh) else None


def from_least(mesh: PolygonMesh) -> Ints:
    """The corners of each face, starting at the one with the smallest number."""
    order = np.lexsort([mesh.face_vertices, mesh.corner_faces])
    starts, face = mesh.face_offsets[:-1], mesh.corner_faces
    turn = (order[starts] - starts)[face]
    within = np.arange(len(face)) - starts[face]
    return np.asarray(mesh.face_vertices[starts[face] + (within + turn) % mesh.valences[face]])


def same_rings(first: PolygonMesh, place: Ints, second: PolygonMesh) -> bool:
    """Whether face ``place[f]`` of ``first`` has the corners of face f of ``second`` in the same
    cyclic order."""
    size = second.valences
    if not np.array_equal(first.valences[place], size):
        return False
    shift = np.repeat(first.face_offsets[place] - second.face_offsets[:-1], size)
    taken = from_least(first)[np.arange(len(shift)) + shift]
    return bool(np.array_equal(taken, from_least(second)))


def _rows(tetrahedra: Ints) -> NDArray[np.void]:
    """One comparable value for each row."""
    return np.ascontiguousarray(np.sort(tetrahedra, axis=1)).view([("", np.int64)] * 4).reshape(-1)
