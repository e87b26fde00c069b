"""Faces of a mesh file that cannot be fanned about their middle, as triangles."""

from __future__ import annotations

import numpy as np

from ..mesh.geometry import face_frames
from ..mesh.polygons import PolygonMesh
from ..mesh.triangulation import triangulated

BEHIND = 1e-9
"""Area of a fan's triangle that faces the other way, over that of its face, which is rounding."""


def without_concave(mesh: PolygonMesh) -> PolygonMesh:
    """``mesh`` with triangles in place of the faces whose middle does not see all of their edges,
    such as the end of a U; these triangles come last. A face that crosses itself stays."""
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
