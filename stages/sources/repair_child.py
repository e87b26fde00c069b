"""Repair of a mesh by pymeshlab, which is under the GPL and may crash: only the child process that
this module becomes imports it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..surface.geometry import fan_triangles
from ..surface.polygons import PolygonMesh

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
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(given, vertices=(vertices - low) / size, triangles=triangles)
        try:
            done = subprocess.run(
                [sys.executable, "-m", __name__, str(given), str(found)],
                capture_output=True, text=True, timeout=SECONDS,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise InputError(
                f"{name}: --repair took longer than {SECONDS} s; leave it out"
            ) from None
        if done.returncode or not found.is_file():
            said = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
            raise InputError(f"{name}: --repair by pymeshlab failed ({said[:120]}); leave it out")
        with np.load(found) as arrays:
            vertices, triangles = arrays["vertices"], arrays["triangles"].astype(np.int64)
    if len(triangles) == 0:
        raise InputError(f"{name}: --repair removes every face; leave it out")
    return PolygonMesh.of_triangles(low + size * vertices, triangles).without_unused_vertices()


def _repair(given: str, found: str) -> None:
    import pymeshlab

    with np.load(given) as arrays:
        mesh = pymeshlab.Mesh(arrays["vertices"], arrays["triangles"].astype(np.int32))
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(mesh)
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_repair_non_manifold_edges(method=0)
    meshes.meshing_repair_non_manifold_vertices()
    meshes.meshing_re_orient_faces_coherently()
    meshes.meshing_close_holes(maxholesize=LARGEST_HOLE)
    meshes.meshing_remove_unreferenced_vertices()
    result = meshes.current_mesh()
    np.savez(found, vertices=result.vertex_matrix(), triangles=result.face_matrix())


if __name__ == "__main__":
    _repair(*sys.argv[1:])
