"""Voronoi cells as closed polyhedra with shared faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface.edits import contract_short_edges, reduce_rings
from ..surface.geometry import face_frames
from ..surface.polygons import Floats, Ints, PolygonMesh
from .cleanup import settle
from .delaunay import Tetrahedra
from .interface import rings_to_surface
from .rings import voronoi_rings
from .vertices import FLAT


@dataclass(frozen=True)
class PolyhedralMesh:
    """Convex cells with shared faces; a face's normal points from its owner to its neighbour."""

    faces: PolygonMesh
    owner: Ints
    neighbour: Ints
    """Cell on the other side ``(F,)``, -1 on the boundary."""
    cell_generator: Ints
    cell_volume: Floats


def polyhedral_mesh(
    generators: Floats,
    inside: NDArray[np.bool_],
    tetrahedra: Tetrahedra,
    merge: float = 0.0,
) -> PolyhedralMesh:
    """The cells of all inside generators of a diagram.

    Edges shorter than ``merge`` are contracted and faces without three corners dropped: where
    more than four generators lie on one sphere the diagram has them by rounding only.
    """

    def select(a: Ints, b: Ints) -> NDArray[np.int8]:
        a_in, b_in = inside[a], inside[b]
        sign = np.where(a_in & b_in, np.where(a < b, 1, -1), a_in.astype(int) - b_in.astype(int))
        return sign.astype(np.int8)

    surface = rings_to_surface(
        generators, tetrahedra, voronoi_rings(generators, tetrahedra, select)
    )
    flat = surface.flatness < FLAT
    faces = surface.mesh.with_vertices(settle(surface.mesh.vertices, surface.mesh, flat))
    pairs = surface.generators
    if merge > 0:
        faces, kept = reduce_rings(faces, contract_short_edges(faces, merge))
        faces, pairs = faces.without_unused_vertices(), pairs[kept]
    cell_generator = np.unique(pairs[inside[pairs]])
    cell = np.full(len(generators), -1, dtype=np.int64)
    cell[cell_generator] = np.arange(len(cell_generator))
    owner, neighbour = cell[pairs[:, 0]], cell[pairs[:, 1]]
    area, normal, centre = face_frames(faces)
    volume = np.zeros(len(cell_generator))
    for sign, side in ((1.0, owner), (-1.0, neighbour)):
        real = side >= 0
        apex = generators[cell_generator[side[real]]]
        height = sign * np.einsum("ij,ij->i", centre[real] - apex, normal[real])
        volume += np.bincount(side[real], area[real] * height / 3, minlength=len(volume))
    return PolyhedralMesh(faces, owner, neighbour, cell_generator, volume)


def open_cells(mesh: PolyhedralMesh) -> int:
    """Number of cells whose faces do not meet two by two along every edge."""
    start, end = mesh.faces.face_vertices, mesh.faces.next_vertices
    count = mesh.faces.vertex_count
    parts = []
    for side, ahead in ((mesh.owner, True), (mesh.neighbour, False)):
        cell = side[mesh.faces.corner_faces]
        real = cell >= 0
        a, b = (start, end) if ahead else (end, start)
        parts.append(np.stack([cell[real], a[real], b[real]], axis=1))
    half = np.concatenate(parts)
    forward = half[:, 1] < half[:, 2]
    edge = np.minimum(half[:, 1], half[:, 2]) * count + np.maximum(half[:, 1], half[:, 2])
    order = np.lexsort((edge, half[:, 0]))
    cell, edge, forward = half[order, 0], edge[order], forward[order]
    group = np.cumsum(
        np.diff(edge, prepend=-1).astype(bool) | np.diff(cell, prepend=-1).astype(bool)
    )
    uses = np.bincount(group)[group]
    ahead_uses = np.bincount(group, forward)[group]
    return len(np.unique(cell[(uses != 2) | (ahead_uses != 1)]))
