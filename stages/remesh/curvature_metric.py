"""The metric of the curvature, in which triangles are long where the surface bends less.

The distance of a triangle to the surface grows with ``|k1| a^2 + |k2| b^2``, for edges of lengths a
and b along the principal directions. For a given area it is least if both terms are equal. Such
triangles are equilateral in a metric that is proportional to the curvature (Alliez et al. 2003).
"""

from __future__ import annotations

import numpy as np

from ..mesh.edge_table import Sized
from ..mesh.geometry import triangle_normals, vertex_normals
from ..mesh.polygons import Floats, Ints

LONGEST = 2.0
"""Largest length of an edge along the direction of least curvature, divided by one across it."""
SMOOTHINGS = 2
"""Number of times that curvatures are averaged over the triangles around each vertex."""
FLAT = 0.3
"""A direction counts as flat if an edge along it deviates from the surface by less than this,
divided by the mean deviation over the shape."""
SMALL = 1e-9
"""A deviation that is added to that bound for shapes that are flat everywhere, in units of h0."""
AT_CREASES = 1e-3
"""Weight of triangles at creases after the first averaging. Before it their weight is 0."""


def metrics(mesh: Sized) -> Floats:
    """The metric at each vertex ``(V, 3, 3)``. It has the determinant 1, and
    is 1 along the normal."""
    normal = vertex_normals(mesh.vertices, mesh.triangles)
    bending, axes = _bending(mesh, normal)
    count = len(mesh.vertices)
    _, area = triangle_normals(mesh.vertices, mesh.triangles)
    # The normal at a crease vertex belongs to neither side of the crease.
    weight = np.where((mesh.rank[mesh.triangles] > 0).any(axis=1), 0.0, area)
    tensor = np.einsum("tai,tab,tbj->tij", axes, bending, axes)
    for _ in range(SMOOTHINGS):
        mean, total = _spread(mesh.triangles, tensor * weight[:, None, None], weight, count)
        mean /= np.maximum(total, np.finfo(float).tiny)[:, None, None]
        tensor = mean[mesh.triangles].mean(axis=1)
        weight = np.where(weight > 0, weight, AT_CREASES * area)
    # The tensors are restricted to the tangent plane of each vertex.
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first)], axis=1)
    value, vector = np.linalg.eigh(np.einsum("vai,vij,vbj->vab", frame, mean, frame))
    # Where the surface bends less than its edges show, no direction is preferred.
    bend = np.abs(value) * mesh.length[:, None] ** 2
    size = np.maximum(bend, FLAT * bend.max(axis=1).mean() + SMALL)
    size = np.maximum(size, size.max(axis=1, keepdims=True) / LONGEST**2)
    # The spheres of long triangles beside a crease would not fit.
    near = mesh.rank > 0
    near[mesh.triangles[near[mesh.triangles].any(axis=1)]] = True
    size[near] = 1.0
    size /= np.sqrt(size.prod(axis=1, keepdims=True))
    along = np.einsum("vab,vai->vbi", vector, frame)
    found = np.einsum("vb,vbi,vbj->vij", size, along, along)
    return np.asarray(found + normal[:, :, None] * normal[:, None, :])


def _spread(triangles: Ints, tensor: Floats, weight: Floats, count: int) -> tuple[Floats, Floats]:
    """Weighted sums of the tensors of the triangles around each vertex, and sums of the weights."""
    flat = triangles.reshape(-1)
    total = np.asarray(np.bincount(flat, np.repeat(weight, 3), minlength=count), np.float64)
    sums = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(3):
            sums[:, i, j] = np.bincount(flat, np.repeat(tensor[:, i, j], 3), minlength=count)
    return sums, total


def _bending(mesh: Sized, normal: Floats) -> tuple[Floats, Floats]:
    """The second fundamental form ``(T, 2, 2)`` of each triangle, and its axes ``(T, 2, 3)``.

    It follows from the change of the vertex normals along the edges (Rusinkiewicz 2004).
    """
    corners, normals = mesh.vertices[mesh.triangles], normal[mesh.triangles]
    way = np.roll(corners, -1, axis=1) - corners
    turn = np.roll(normals, -1, axis=1) - normals
    first = way[:, 0] / np.maximum(np.linalg.norm(way[:, 0], axis=1, keepdims=True), 1e-300)
    facing, _ = triangle_normals(mesh.vertices, mesh.triangles)
    axes = np.stack([first, np.cross(facing, first)], axis=1)
    u, v = np.einsum("tki,tai->atk", way, axes)
    du, dv = np.einsum("tki,tai->atk", turn, axes)
    # Least squares for (a, b, c) in du = a u + b v and dv = b u + c v.
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    zero = 0 * uu
    matrix = np.stack(
        [np.stack([uu, uv, zero], 1), np.stack([uv, uu + vv, uv], 1), np.stack([zero, uv, vv], 1)],
        axis=1,
    )
    right = np.stack([(u * du).sum(1), (v * du + u * dv).sum(1), (v * dv).sum(1)], axis=1)
    tiny = 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-300
    a, b, c = np.linalg.solve(matrix + tiny * np.eye(3), right[:, :, None])[:, :, 0].T
    return np.stack([np.stack([a, b], 1), np.stack([b, c], 1)], axis=1), axes
