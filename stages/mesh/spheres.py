"""Spheres at the surface vertices: where they start, and which targets they may intrude on."""

from __future__ import annotations

import numpy as np

from .geometry import face_frames
from .polygons import Floats, Ints, PolygonMesh


def initial_spheres(mesh: PolygonMesh) -> tuple[Floats, Floats]:
    """Radii ``(V,)`` and offsets ``(F,)`` to start from (paper, section 3.3).

    ``r_v`` is the mean distance from a vertex to the centroids of its faces, ``delta_f`` the square
    root of the face's area.
    """
    area, _, centroid = face_frames(mesh)
    reach = np.linalg.norm(mesh.vertices[mesh.face_vertices] - centroid[mesh.corner_faces], axis=1)
    total = np.bincount(mesh.face_vertices, reach, minlength=mesh.vertex_count)
    count = np.bincount(mesh.face_vertices, minlength=mesh.vertex_count)
    return total / np.maximum(count, 1), np.sqrt(area)


def near_pairs(
    mesh: PolygonMesh, targets: Floats, centres: Floats, radii: Floats, slack: float, threads: int
) -> tuple[Ints, Ints]:
    """Targets within ``(1 + slack) r_v`` of a sphere that is not incident to their face.

    ``targets (2F, 3)``: first the outer, then the inner target of every face. Returns indices into
    targets and spheres, ``(P,)`` each, sorted by sphere.
    """
    from scipy.spatial import cKDTree

    found = cKDTree(targets).query_ball_point(
        centres, (1 + slack) * radii, workers=threads, return_sorted=True
    )
    count = np.fromiter((len(row) for row in found), np.int64, len(found))
    point = np.concatenate([np.asarray(row, np.int64) for row in found] or [np.zeros(0, np.int64)])
    sphere = np.repeat(np.arange(len(centres)), count)
    incident = np.sort(mesh.corner_faces * mesh.vertex_count + mesh.face_vertices)
    key = (point % mesh.face_count) * mesh.vertex_count + sphere
    at = np.minimum(np.searchsorted(incident, key), len(incident) - 1)
    apart = incident[at] != key
    return point[apart], sphere[apart]
