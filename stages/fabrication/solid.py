"""Solids and shells, and the cells of a volume as tubes along their edges or as separate bodies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import NumericalFailure, UsageError
from ..mesh.geometry import fan_triangles
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.solids import solid_of
from ..mesh.topology import edges

GRID = 128
"""Number of cells of the distance grid along the longest side. There are more if the wall would be
thinner than two cells."""
MOST_GRID = 256


def shell(surface: PolygonMesh, wall: float) -> tuple[Any, Floats]:
    """A hollow body with a wall nowhere thinner than ``wall``, from ``surface`` in mm.

    The second value is the distance ``(N,)`` of each vertex of the inner side from the outer one.
    The inner side is a level set of the distance on a grid. It is moved inward by half a cell,
    which is more than the error of linear interpolation. Raises UsageError if nothing is that far
    inside.
    """
    import igl
    from manifold3d import Manifold, Mesh64

    from ..mesh.queries.triangle_tree import TriangleTree

    solid = solid_of(surface)
    vertices, triangles, _ = fan_triangles(surface)
    longest = float(np.ptp(vertices, axis=0).max())
    cells = int(np.clip(np.ceil(2 * longest / wall), GRID, MOST_GRID))
    level = -(wall + 0.5 * longest / cells)
    inner, faces, *_ = igl.offset_surface(
        vertices, triangles, level, cells, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )
    if len(faces) == 0:
        raise UsageError(f"--wall {wall:g}: no part of the shape is that thick; lower it")
    # Depending on the version, marching cubes orients its triangles to the lower or the upper side.
    corners = inner[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    hollow = Manifold(Mesh64(inner, faces.astype(np.uint64)))
    if hollow.status().name != "NoError":
        raise NumericalFailure(
            f"the inner side of the shell is not a solid ({hollow.status().name}); change --wall "
            "a little"
        )
    square, _, _ = TriangleTree(vertices, triangles).closest(inner)
    return solid - hollow, np.sqrt(square)


def edges_of(arrays: Mapping[str, Any], which: str) -> Ints:
    """Edges ``(E, 2)`` of the volume: those of its surface, those inside
    (``volume``), or ``both``."""
    cells = PolygonMesh.from_arrays(arrays)
    taken = edges(cells)
    if which == "both":
        return taken
    outer = edges(cells.select_faces(np.asarray(arrays["face_neighbour"]) < 0))
    if which == "surface":
        return outer
    key = cells.vertex_count
    inner = ~np.isin(taken @ [key, 1], outer @ [key, 1])
    return np.asarray(taken[inner])


def exploded(arrays: Mapping[str, Any], factor: float) -> tuple[Floats, Ints]:
    """Vertices and triangles of all cells, each closed by itself.

    The cells are moved away from the centre, so that distances between them grow by ``factor``.
    """
    mesh = PolygonMesh.from_arrays(arrays)
    vertices, triangles, face = fan_triangles(mesh)
    owner, neighbour = (np.asarray(arrays[f"face_{side}"])[face] for side in ("owner", "neighbour"))
    both = np.concatenate([triangles, triangles[neighbour >= 0][:, ::-1]])
    cell = np.concatenate([owner, neighbour[neighbour >= 0]])
    pairs, index = np.unique(cell[:, None] * len(vertices) + both, return_inverse=True)
    of_cell, of_vertex = np.divmod(pairs, len(vertices))
    corners = vertices[of_vertex]
    count = np.bincount(of_cell)
    centre = np.stack([np.bincount(of_cell, corners[:, axis]) / count for axis in range(3)], axis=1)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    moved = corners + (factor - 1) * (centre - middle)[of_cell]
    return moved, index.reshape(-1, 3)
