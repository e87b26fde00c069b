"""Simplify surfaces that are too large for a page."""

from __future__ import annotations

import numpy as np

from ..mesh.polygons import Floats, Ints, PolygonMesh

TRIANGLES = 200_000
"""Largest number of triangles of a surface on a page, which a browser without a graphics card can
draw."""


def simplified(vertices: Floats, triangles: Ints, tolerance: float) -> tuple[Floats, Ints, float]:
    """A closed triangle surface with no more than TRIANGLES, and the tolerance that it took.

    Edges are contracted as long as nothing moves by more than ``tolerance``, which is doubled
    until the triangles are few enough. A surface that is no solid is given to ``clustered``.
    """
    from manifold3d import Error, Manifold, Mesh64

    solid = Manifold(Mesh64(vertices, triangles.astype(np.uint64)))
    if solid.status() != Error.NoError:
        return clustered(vertices, triangles)
    while solid.num_tri() > TRIANGLES:
        tolerance *= 2
        solid = solid.simplify(tolerance)
    mesh = solid.to_mesh64()
    return (
        np.asarray(mesh.vert_properties, np.float64)[:, :3],
        np.asarray(mesh.tri_verts, np.int64),
        tolerance,
    )


def clustered(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints, float]:
    """Cluster the vertices of any triangles on a grid until there are few enough; returns the edge
    of its cells too."""
    low, extent = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    cells = 1024
    while True:
        edge = extent / cells
        place = np.floor((vertices - low) / edge).astype(np.int64)
        _, first, of = np.unique(place, axis=0, return_index=True, return_inverse=True)
        corners = of.reshape(-1)[triangles]
        whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        if whole.sum() <= TRIANGLES:
            return vertices[first], corners[whole], edge
        cells = cells * 3 // 4


def thinned(points: Floats, most: int) -> Floats:
    """Evenly chosen rows of ``points``, ``most`` of them if there are more."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(np.int64)]


def voxel_surface(interior: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> PolygonMesh:
    """The squares between the voxels inside and those outside, in voxels."""
    padded = np.pad(interior, 1)
    corners = []
    for axis in range(3):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        for step in (1, -1):
            i = np.argwhere(padded & ~np.roll(padded, -step, axis=axis)) - 1
            square = np.repeat(i[:, None, :], 4, axis=1)
            square[:, :, axis] += step > 0
            ring = (
                [(0, 0), (1, 0), (1, 1), (0, 1)] if step > 0 else [(0, 0), (0, 1), (1, 1), (1, 0)]
            )
            square[:, :, others] += np.array(ring)
            corners.append(square)
    every = np.concatenate(corners).reshape(-1, 3)
    places, index = np.unique(every, axis=0, return_inverse=True)
    return PolygonMesh.of_triangles(places.astype(np.float64), index.reshape(-1, 4))
