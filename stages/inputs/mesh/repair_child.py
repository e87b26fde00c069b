"""Repair of a mesh by pymeshlab, which is under the GPL and may crash: only the child process that
this module becomes imports it."""

from __future__ import annotations

import numpy as np

from ...child import Arrays, ChildFailed, answer, in_child
from ...errors import InputError
from ...mesh.geometry import fan_triangles
from ...mesh.polygons import PolygonMesh

SECONDS = 300
LARGEST_HOLE = 10_000
"""Edges around a hole that is closed."""


def repaired(mesh: PolygonMesh, name: str) -> PolygonMesh:
    """Triangles of ``mesh`` without what is there twice or has no area, without edges of more than
    two faces and vertices of several fans, turned to agree, holes closed.

    Raises InputError, with the ``name`` of the mesh, when pymeshlab fails or is not installed.
    """
    vertices, triangles, _ = fan_triangles(mesh)
    # pymeshlab may compute in single precision.
    low, size = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    given = {"vertices": (vertices - low) / size, "triangles": triangles}
    try:
        found = in_child(__name__, given, SECONDS)
    except ChildFailed as error:
        raise InputError(f"{name}: --repair by pymeshlab failed: {error}; leave it out") from None
    triangles = found["triangles"].astype(np.int64)
    if len(triangles) == 0:
        raise InputError(f"{name}: --repair removes every face; leave it out")
    return PolygonMesh.of_triangles(
        low + size * found["vertices"].astype(float), triangles
    ).without_unused_vertices()


def _repair(given: Arrays) -> Arrays:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(given["vertices"], given["triangles"].astype(np.int32)))
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_repair_non_manifold_edges(method=0)
    meshes.meshing_repair_non_manifold_vertices()
    meshes.meshing_re_orient_faces_coherently()
    meshes.meshing_close_holes(maxholesize=LARGEST_HOLE)
    meshes.meshing_remove_unreferenced_vertices()
    result = meshes.current_mesh()
    return {"vertices": result.vertex_matrix(), "triangles": result.face_matrix()}


if __name__ == "__main__":
    answer(_repair)
