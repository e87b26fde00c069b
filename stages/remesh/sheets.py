"""Opposite sheets of a closed surface that are too near to each other moved apart, and what is
sharper than its edges are long made round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import vertex_normals
from ..mesh.polygons import Floats
from ..mesh.queries.thickness import across, searched
from .embedding import kept_embedded

APART = 1.2
"""Distance of opposite sheets that leaves room for their spheres, in target lengths."""
STEP, ROUNDS = 0.4, 4
"""Share of the missing distance made up by each of the two sheets in one round, and the rounds."""
SMOOTHINGS = 3
BACK = 6
"""The most rounds in which sheets draw back from each other."""
FACING = -0.3
"""Cosine of two normals below which vertices are of opposite sheets."""
ACROSS = 0.6
"""Cosine to both normals above which the way between two vertices leads across."""


def part(mesh: Sized, where: NDArray[np.bool_]) -> None:
    """Move vertices ``where (V,)`` along their normals until opposite sheets are APART: a body that
    is too thin becomes thicker, a gap wider. No triangles cross then that did not before."""
    table = EdgeTable.of(mesh.triangles)
    row = np.flatnonzero(where)
    wanted = APART * mesh.length[row]
    for _ in range(ROUNDS):
        normal = vertex_normals(mesh.vertices, mesh.triangles)
        tree, facets = searched(mesh.vertices, mesh.triangles)
        through, gap = across(tree, facets, mesh.vertices[row], normal[row])[0]
        missing = [np.maximum(0.0, wanted - distance) for distance in (through, gap)]
        if not np.any(missing):
            break
        shift = np.zeros(len(mesh.vertices))
        shift[row] = STEP * (missing[0] - missing[1])
        moved = mesh.vertices + _spread(table, shift, where)[:, None] * normal
        mesh.vertices = kept_embedded(mesh.vertices, moved, mesh.triangles)


def draw_back(mesh: Sized, where: NDArray[np.bool_]) -> None:
    """Move vertices ``where (V,)`` along their normals until sheets that have gone through each
    other are APART: both bodies draw back from what they have in common."""
    from scipy.spatial import cKDTree

    from ..mesh.queries.parity import RayParity

    table = EdgeTable.of(mesh.triangles)
    for _ in range(BACK):
        chosen = np.flatnonzero(where)
        normal = vertex_normals(mesh.vertices, mesh.triangles)
        at = mesh.vertices[chosen]
        reach = APART * float(mesh.length[chosen].max(initial=0.0))
        a, b = chosen[cKDTree(at).query_pairs(reach, output_type="ndarray")].T
        way = mesh.vertices[b] - mesh.vertices[a]
        distance = np.linalg.norm(way, axis=1)
        way /= np.maximum(distance, np.finfo(float).tiny)[:, None]
        wanted = 0.5 * APART * (mesh.length[a] + mesh.length[b])
        near = (np.einsum("ij,ij->i", normal[a], normal[b]) < FACING) & (distance < wanted)
        for end in (a, b):
            near &= np.abs(np.einsum("ij,ij->i", way, normal[end])) > ACROSS
        a, b, distance, wanted = a[near], b[near], distance[near], wanted[near]
        between = 0.5 * (mesh.vertices[a] + mesh.vertices[b])
        twice = RayParity(mesh.vertices, mesh.triangles).winding(between) > 1
        if not twice.any():
            break
        back = np.zeros(len(mesh.vertices))
        for end in (a[twice], b[twice]):
            np.minimum.at(back, end, -STEP * (wanted + distance)[twice])
        mesh.vertices = mesh.vertices + _spread(table, back, where)[:, None] * normal


def smooth(mesh: Sized, where: NDArray[np.bool_]) -> None:
    """Move vertices ``where (V,)`` that are free towards the mean of their neighbours: tips, edges
    and folds become round. No triangles cross then that did not before."""
    table, before = EdgeTable.of(mesh.triangles), mesh.vertices
    free = (where & (mesh.rank == 0))[:, None]
    for _ in range(SMOOTHINGS):
        mean = table.mean_of_neighbours(mesh.vertices)
        mesh.vertices = np.where(free, 0.5 * (mesh.vertices + mean), mesh.vertices)
    mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)


def _spread(table: EdgeTable, shift: Floats, where: NDArray[np.bool_]) -> Floats:
    """``shift (V,)`` and, beside it, half the mean of the neighbours' shifts."""
    return np.where((shift == 0) & where, 0.5 * table.mean_of_neighbours(shift), shift)
