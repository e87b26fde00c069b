"""Checks that solvers need: cells are closed, simply connected, and of positive volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mesh.polygons import Floats, Ints
from ...mesh.polyhedra import PolyhedralMesh
from ...mesh.topology import edge_keys


def cell_faults(mesh: PolyhedralMesh, points: Floats) -> dict[str, NDArray[np.bool_]]:
    """The cells ``(C,)`` that fail each of six checks, by the name of the check.

    ``open``: an edge is not in exactly two faces of the cell.
    ``not_spheres``: V - E + F is not 2.
    ``torn_faces``: a face has a vertex twice.
    ``crossed_faces``: the vertices that two faces share do not form one path along both.
    ``few_faces``: the cell has fewer than four faces.
    ``folded``: a tetrahedron from the cell's centroid to a part of a face has no positive volume.

    ``points (C, 3)`` lie near the cells, which keeps rounding errors small.
    """
    from scipy.sparse import coo_array

    cells, faces = mesh.cell_count, mesh.faces
    pieces = mesh.tetrahedron_volumes(mesh.solids(points)[1])
    half_face, half_cell, _ = mesh.half_faces
    size = faces.valences[half_face]
    half = np.repeat(np.arange(len(half_face)), size)
    within = np.arange(len(half)) - np.repeat(np.cumsum(size) - size, size)
    corner = faces.face_offsets[half_face[half]] + within
    cell = half_cell[half]
    vertex_key = cell * faces.vertex_count + faces.face_vertices[corner]
    edge, number = np.unique(edge_keys(faces)[0], return_inverse=True)
    edge_key = cell * len(edge) + number[corner]

    vertices, vertex_number = np.unique(vertex_key, return_inverse=True)
    edges, edge_number, uses = np.unique(edge_key, return_inverse=True, return_counts=True)
    vertex_count = np.bincount(vertices // faces.vertex_count, minlength=cells)
    edge_cell = edges // max(len(edge), 1)
    edge_count = np.bincount(edge_cell, minlength=cells)
    face_count = np.bincount(half_cell, minlength=cells)

    once = np.ones(len(half), np.int32)
    incidence = coo_array(
        (once, (half, vertex_number)), shape=(len(half_face), len(vertices))
    ).tocsr()
    torn = _marked(cells, half_cell[incidence.nonzero()[0][incidence.data > 1]])
    meets = coo_array((once, (half, edge_number)), shape=(len(half_face), len(edges))).tocsr()
    shared, along = (incidence @ incidence.T).tocoo(), (meets @ meets.T).tocsr()
    other = shared.row < shared.col
    row, column, common = shared.row[other], shared.col[other], shared.data[other]
    lines = np.asarray(along[row, column]).reshape(-1)
    # A path of k edges has k + 1 points. Two faces that share all edges are the same face.
    crossed = common != lines + 1
    return {
        "open": _marked(cells, edge_cell[uses != 2]),
        "not_spheres": vertex_count - edge_count + face_count != 2,
        "torn_faces": torn,
        "crossed_faces": _marked(cells, half_cell[row[crossed]]),
        "few_faces": face_count < 4,
        "folded": _marked(cells, mesh.tetrahedra[2][~(pieces > 0)]),
    }


def _marked(count: int, cells: Ints) -> NDArray[np.bool_]:
    marked = np.zeros(count, dtype=bool)
    marked[cells] = True
    return marked
