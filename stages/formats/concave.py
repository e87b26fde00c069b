"""Triangulation of faces of a mesh file that cannot become a fan about the
mean of their corners."""

from __future__ import annotations

import numpy as np

from ..mesh.geometry import face_frames
from ..mesh.polygons import PolygonMesh
from ..mesh.triangulation import triangulated

BEHIND = 1e-9
"""A triangle of a fan faces the wrong way if its signed area, divided by that of the face, is below
minus this. Smaller values are rounding."""


def without_concave(mesh: PolygonMesh) -> PolygonMesh:
    """``mesh`` with triangles instead of those faces whose middle does not see all their edges.

    The end of a U is such a face. The triangles come after all other faces. A face that crosses
    itself is not changed.
    """
    area, normal, centroid = face_frames(mesh)
    middle = centroid[mesh.corner_faces]
    here, there = (
        mesh.vertices[corner] - middle for corner in (mesh.face_vertices, mesh.next_vertices)
    )
    fans = 0.5 * np.einsum("ij,ij->i", np.cross(here, there), normal[mesh.corner_faces])
    concave = np.unique(mesh.corner_faces[fans < -BEHIND * area[mesh.corner_faces]])
    kept, triangles = np.ones(mesh.face_count, dtype=bool), []
    for face in concave[mesh.valences[concave] > 3]:
        ring = mesh.face_vertices[mesh.face_offsets[face] : mesh.face_offsets[face + 1]]
        found = triangulated(mesh.vertices, [ring], normal[face])
        if found is not None:
            kept[face] = False
            triangles.append(found)
    if not triangles:
        return mesh
    left, corners = mesh.select_faces(kept), np.concatenate(triangles)
    ends = left.face_offsets[-1] + 3 * np.arange(1, len(corners) + 1)
    return PolygonMesh(
        mesh.vertices,
        np.concatenate([left.face_offsets, ends]),
        np.concatenate([left.face_vertices, corners.reshape(-1)]),
    )
