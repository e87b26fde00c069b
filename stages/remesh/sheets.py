"""Changes that give spheres room: opposite sheets move apart, and sharp places become round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import vertex_normals
from ..mesh.polygons import Floats
from ..mesh.queries.thickness import across, searched
from .embedding import kept_embedded

APART = 1.2
"""Distance of opposite sheets at which their spheres have room, in target lengths."""
STEP, ROUNDS = 0.4, 4
"""Share of the missing distance by which each of two sheets moves in one round, and
the number of rounds."""
SMOOTHINGS = 3
"""Number of times that vertices move towards the mean of their neighbours."""
BACK = 6
"""Largest number of rounds in which sheets that cross are moved apart."""
FACING = -0.3
"""Vertices are on opposite sheets if the cosine of their normals is less."""
ACROSS = 0.6
"""The line between two vertices goes from sheet to sheet if its cosine with
both normals is larger."""


def part(mesh: Sized, where: NDArray[np.bool_]) -> None:
    """Move vertices ``where (V,)`` along their normals until opposite sheets have the distance
    APART.

    A body that is too thin becomes thicker, a gap wider. Moves after which triangles would newly
    cross are undone.
    """
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
    """Move vertices ``where (V,)`` along their normals until sheets that overlap have the distance
    APART.

    Both bodies withdraw from the volume that they have in common.
    """
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
    """Move free vertices ``where (V,)`` towards the mean of their neighbours.

    Tips, edges and folds become round. Moves after which triangles would newly cross are undone.
    """
    table, before = EdgeTable.of(mesh.triangles), mesh.vertices
    free = (where & (mesh.rank == 0))[:, None]
    for _ in range(SMOOTHINGS):
        mean = table.mean_of_neighbours(mesh.vertices)
        mesh.vertices = np.where(free, 0.5 * (mesh.vertices + mean), mesh.vertices)
    mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)


def _spread(table: EdgeTable, shift: Floats, where: NDArray[np.bool_]) -> Floats:
    """``shift (V,)``, and half the mean of the neighbours' shifts at vertices without one."""
    return np.where((shift == 0) & where, 0.5 * table.mean_of_neighbours(shift), shift)
