"""A mesh that encloses nothing, as a sheet of some thickness."""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from ...mesh.geometry import fan_triangles
from ...mesh.polygons import PolygonMesh
from ...mesh.topology import bad_edges

ACROSS = 3.0
"""Edges of the grid across the sheet."""
MOST = 30_000_000
"""Nodes of the grid."""


def thickened(mesh: PolygonMesh, thickness: float, name: str) -> PolygonMesh:
    """The surface around all that is within half of ``thickness`` of ``mesh``, as triangles.

    Raises InputError, with the ``name`` of the mesh, when that is too thin for its size.
    """
    import igl

    from ...mesh.queries.triangle_tree import TriangleTree

    vertices, triangles, _ = fan_triangles(mesh)
    edge = thickness / ACROSS
    low = vertices.min(axis=0) - 0.5 * thickness - 1.5 * edge
    high = vertices.max(axis=0) + 0.5 * thickness + 1.5 * edge
    shape = np.ceil((high - low) / edge).astype(np.int64) + 1
    if float(np.prod(shape.astype(float))) > MOST:
        raise InputError(
            f"{name}: a sheet {thickness:g} thick is too thin for its size; raise --thickness"
        )
    nodes = (
        low
        + edge
        * np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape[::-1])), axis=1)[:, ::-1]
    )  # the first index runs fastest
    nodes = np.ascontiguousarray(nodes)
    square, _, _ = TriangleTree(vertices, triangles).closest(nodes)
    made, faces, _ = igl.marching_cubes(
        np.sqrt(square) - 0.5 * thickness, nodes, *map(int, shape), 0.0
    )
    found = PolygonMesh.of_triangles(np.asarray(made), np.asarray(faces, np.int64))
    if found.face_count == 0 or len(bad_edges(found)):
        raise InputError(f"{name}: no closed surface lies around it; set another --thickness")
    return found
