"""OVM: polyhedra in the text format of OpenVolumeMesh."""

from __future__ import annotations

import numpy as np

from ..mesh.polyhedra import PolyhedralMesh
from ..mesh.topology import edge_keys
from .text import lists, rows


def encode(mesh: PolyhedralMesh) -> bytes:
    """``mesh`` as an OVM file.

    Edge e has the half-edges 2 e forwards and 2 e + 1 backwards. Face f has the half-faces 2 f and,
    seen from behind, 2 f + 1. The half-faces of a cell face inward, as OpenVolumeMesh expects.
    """
    faces = mesh.faces
    keys, forward = edge_keys(faces)
    edge, number = np.unique(keys, return_inverse=True)
    half_edges = 2 * number + ~forward
    half_face, half_cell, back = mesh.half_faces
    offsets = np.concatenate([[0], np.cumsum(np.bincount(half_cell, minlength=mesh.cell_count))])
    text = (
        f"OVM ASCII\nVertices\n{faces.vertex_count}\n{rows(faces.vertices)}\n"
        f"Edges\n{len(edge)}\n{rows(np.stack(np.divmod(edge, faces.vertex_count), axis=1))}\n"
        f"Faces\n{faces.face_count}\n{lists(faces.face_offsets, half_edges)}\n"
        f"Polyhedra\n{mesh.cell_count}\n{lists(offsets, 2 * half_face + ~back)}\n"
    )
    return text.encode("ascii")
