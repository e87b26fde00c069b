"""Closed surfaces that cross themselves, resolved by libigl's exact booleans, which are made with
CGAL under the GPL: only the child process that this module becomes imports them."""

from __future__ import annotations

import numpy as np

from ...child import Arrays, ChildFailed, answer, in_child
from ...mesh.polygons import PolygonMesh

SECONDS = 300


def uncrossed(mesh: PolygonMesh) -> PolygonMesh | None:
    """The surface of where the closed triangles of ``mesh`` wind around a point at least once; None
    where libigl fails, or it is empty."""
    given = {"vertices": mesh.vertices, "triangles": mesh.face_vertices.reshape(-1, 3)}
    try:
        found = in_child(__name__, given, SECONDS)
    except ChildFailed:
        return None
    triangles = found["triangles"].astype(np.int64)
    if len(triangles) == 0:
        return None
    return PolygonMesh.of_triangles(found["vertices"].astype(float), triangles)


def _resolve(given: Arrays) -> Arrays:
    from igl.copyleft.cgal import mesh_boolean

    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, triangles, *_ = mesh_boolean(
        given["vertices"].astype(float), given["triangles"].astype(np.int64), *nothing, "union"
    )
    return {"vertices": vertices, "triangles": triangles}


if __name__ == "__main__":
    answer(_resolve)
