"""Opposite sheets of a closed surface that are too near to each other moved apart, and what is
sharper than its edges are long made round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .edge_table import EdgeTable, Sized
from .embedding import kept_embedded
from .geometry import vertex_normals
from .polygons import Floats
from .thickness import across, searched

APART = 1.2
"""Distance of opposite sheets that leaves room for their spheres, in target lengths."""
STEP, ROUNDS = 0.4, 4
"""Share of the missing distance made up by each of the two sheets in one round, and the rounds."""
SMOOTHINGS = 3


def part(mesh: Sized, where: NDArray[np.bool_]) -> None:
    """Move vertices ``where (V,)`` along their normals until opposite sheets are APART: a body that
    is too thin becomes thicker, a gap wider. No triangles cross then that did not before."""
    table = EdgeTable.of(mesh.triangles)
    row = np.flatnonzero(where)
    wanted = APART * mesh.length[row]
    for _ in range(ROUNDS):
        normal = vertex_normals(mesh.vertices, mesh.triangles)
        found = searched(mesh.vertices, mesh.triangles)
        through, gap = across(*found, found[1][row], normal[row])[0]
        missing = [np.maximum(0.0, wanted - distance) for distance in (through, gap)]
        if not np.any(missing):
            break
        shift = np.zeros(len(mesh.vertices))
        shift[row] = STEP * (missing[0] - missing[1])
        moved = mesh.vertices + _spread(table, shift, where)[:, None] * normal
        mesh.vertices = kept_embedded(mesh.vertices, moved, mesh.triangles)


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
