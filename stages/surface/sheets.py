"""Opposite sheets of a closed surface that are too near to each other, or overlap, moved apart."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .edge_table import EdgeTable, Sized
from .embedding import kept_embedded
from .geometry import vertex_normals
from .polygons import Floats

FACING = -0.3
"""Cosine of two normals below which vertices are of opposite sheets."""
ACROSS = 0.6
"""Cosine to both normals above which the way between two vertices leads across."""
APART = 1.5
"""Distance of opposite sheets that leaves room for their spheres, in target lengths."""
STEP, ROUNDS = 0.5, 6
"""Share of the missing distance made up in one round, and the most rounds."""


def part(mesh: Sized, where: NDArray[np.bool_]) -> int:
    """Move vertices ``where (V,)`` until opposite sheets are APART; how many still are not.

    What lies between two sheets decides: outside, they draw back into their bodies; inside, the
    body is made thicker; where two bodies overlap, they draw back from each other. No triangles
    cross then that did not before.
    """
    from scipy.spatial import cKDTree

    from ..sources.parity import RayParity

    table, before = EdgeTable.of(mesh.triangles), mesh.vertices
    left = 0
    for _ in range(ROUNDS):
        chosen = np.flatnonzero(where)
        normal = vertex_normals(mesh.vertices, mesh.triangles)
        at = mesh.vertices[chosen]
        reach = APART * float(mesh.length[chosen].max(initial=0.0))
        pairs: Any = cKDTree(at).query_pairs(reach, output_type="ndarray")
        a, b = chosen[pairs].T
        way = mesh.vertices[b] - mesh.vertices[a]
        distance = np.linalg.norm(way, axis=1)
        way /= np.maximum(distance, np.finfo(float).tiny)[:, None]
        wanted = 0.5 * APART * (mesh.length[a] + mesh.length[b])
        near = (np.einsum("ij,ij->i", normal[a], normal[b]) < FACING) & (distance < wanted)
        for end in (a, b):
            near &= np.abs(np.einsum("ij,ij->i", way, normal[end])) > ACROSS
        a, b, distance, wanted = a[near], b[near], distance[near], wanted[near]
        between = 0.5 * (mesh.vertices[a] + mesh.vertices[b])
        wound = RayParity(mesh.vertices, mesh.triangles).winding(between)
        missing = np.where(wound > 1, wanted + distance, wanted - distance)
        left = len(a)
        if left == 0:
            break
        push = np.where(wound == 1, 0.5, -0.5) * STEP * missing
        shift = np.zeros(len(mesh.vertices))
        for end in (a, b):
            for sign in (1.0, -1.0):
                most = np.zeros(len(shift))
                np.maximum.at(most, end, sign * push)
                shift = np.where(most > np.abs(shift), sign * most, shift)
        mesh.vertices = mesh.vertices + _spread(table, shift, where)[:, None] * normal
    mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)
    return left


def _spread(table: EdgeTable, shift: Floats, where: NDArray[np.bool_]) -> Floats:
    """``shift (V,)`` and, beside it, half the mean of the neighbours' shifts."""
    start, end = np.concatenate([table.ends, table.ends[:, ::-1]]).T
    total = np.bincount(start, shift[end], minlength=len(shift))
    mean = total / np.maximum(np.bincount(start, minlength=len(shift)), 1)
    return np.where((shift == 0) & where, 0.5 * mean, shift)
