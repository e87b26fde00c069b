"""Least-squares fit of a triangle surface to a true surface, in both directions.

Samples of the triangles are pulled to their closest points on the true surface. Samples of the true
surface pull the triangle that is closest to them, so that tips, creases and corners are reached
that no sample of the triangles would find. For each sample, the true surface is replaced by the
plane through the closest point, perpendicular to the line from the sample to it (point to plane,
Chen and Medioni 1992). With fixed planes, the distances are linear in the vertices, and one damped
Gauss-Newton step moves all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import limited, triangle_normals, vertex_normals
from ..mesh.polygons import Floats, Ints
from ..solvers.least_squares import Block, GaussNewton

if TYPE_CHECKING:
    from ..mesh.queries.true_surface import NearSurface

VERTEX, EDGE, MIDDLE = 3 / 60, 8 / 60, 27 / 60
"""Weights of corners, edge midpoints and centroid in a quadrature that is exact for cubics."""
ON_SURFACE = 1e-6
"""Distance to the surface, in model units, below which its direction is taken from the normal."""
AGAINST = -0.2
"""A triangle is on another sheet than a sample if the cosine of their normals is less."""
REACH = 0.3
"""The distance that counts like a difference of 1 between normals when sheets are told apart."""
CANDIDATES = 4
"""Number of triangles that are tried if the closest one is on another sheet."""
DAMPING = 0.05
"""Damping of a fit, in units of the mean diagonal of its normal matrix."""
LONGEST_STEP = 0.5
"""Largest move of a vertex in one fit, in target lengths."""


@dataclass(frozen=True)
class Rows:
    """Samples ``sum_k weights[:, k] * vertices[corners[:, k]]``, and the plane of each.

    ``corners`` and ``weights`` are ``(R, 3)``. A plane has the unit normal ``direction (R, 3)`` and
    the ``offset (R,)``. ``share (R,)`` is the part of the surface that a sample represents; the sum
    is 1.
    """

    corners: Ints
    weights: Floats
    direction: Floats
    offset: Floats
    share: Floats

    def some(self, chosen: NDArray[np.bool_]) -> Rows:
        """The samples ``chosen (R,)``."""
        return Rows(*(getattr(self, item.name)[chosen] for item in fields(self)))

    def distance(self, vertices: Floats) -> Floats:
        """The signed distances ``(R,)`` of the samples to their planes."""
        at = np.einsum("rk,rkd->rd", self.weights, vertices[self.corners])
        return np.asarray(np.einsum("rd,rd->r", at, self.direction) - self.offset)

    def gradient(self) -> Floats:
        """The derivatives ``(R, 3, 3)`` of the distances by the three vertices."""
        return self.weights[:, :, None] * self.direction[:, None, :]


def forward(surface: NearSurface, vertices: Floats, triangles: Ints) -> Rows:
    """Samples of the triangles (corners, edge midpoints, centroids), and their closest points."""
    table = EdgeTable.of(triangles)
    normal, area = triangle_normals(vertices, triangles)
    count, (a, b) = len(vertices), table.ends.T
    corners = np.concatenate(
        [np.repeat(np.arange(count)[:, None], 3, axis=1), np.stack([a, b, a], 1), triangles]
    )
    weights = np.concatenate(
        [
            np.tile([1.0, 0.0, 0.0], (count, 1)),
            np.tile([0.5, 0.5, 0.0], (len(a), 1)),
            np.full((len(triangles), 3), 1 / 3),
        ]
    )
    share = np.concatenate(
        [
            VERTEX * np.bincount(triangles.reshape(-1), np.repeat(area, 3), minlength=count),
            EDGE * area[table.triangles].sum(axis=1),
            MIDDLE * area,
        ]
    )
    facing = np.concatenate(
        [vertex_normals(vertices, triangles), normal[table.triangles].sum(axis=1), normal]
    )
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), np.finfo(float).tiny)
    at = np.einsum("rk,rkd->rd", weights, vertices[corners])
    foot, outward = surface.closest(at, facing)
    direction = _across(at - foot, outward)
    offset = np.einsum("ij,ij->i", direction, foot)
    return Rows(corners, weights, direction, offset, share / share.sum())


def backward(surface: NearSurface, vertices: Floats, triangles: Ints) -> Rows:
    """The points of the triangles that are closest to the samples of the true surface."""
    points, normals = surface.samples, surface.normals
    triangle, place = _closest(points, normals, vertices, triangles)
    corners = vertices[triangles[triangle]]
    u, v, at = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], place - corners[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    au, av = np.einsum("ij,ij->i", at, u), np.einsum("ij,ij->i", at, v)
    determinant = np.maximum(uu * vv - uv * uv, np.finfo(float).tiny)
    s, t = (vv * au - uv * av) / determinant, (uu * av - uv * au) / determinant
    direction = _across(place - points, normals)
    return Rows(
        triangles[triangle],
        np.stack([1 - s - t, s, t], axis=1),
        direction,
        np.einsum("ij,ij->i", direction, points),
        np.full(len(points), 1 / len(points)),
    )


def _across(way: Floats, otherwise: Floats) -> Floats:
    """``way (N, 3)`` as unit vectors; where it is shorter than ON_SURFACE, ``otherwise (N, 3)``."""
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return np.where(length > ON_SURFACE, way / np.maximum(length, ON_SURFACE), otherwise)


def _closest(
    points: Floats, normals: Floats, vertices: Floats, triangles: Ints
) -> tuple[Ints, Floats]:
    """The closest triangle to each point, and the closest point on it.

    A triangle whose normal opposes the point's is replaced by one of the same sheet, if one is
    near.
    """
    from scipy.spatial import cKDTree

    from ..mesh.queries.projection import closest_on_triangles
    from ..mesh.queries.triangle_tree import TriangleTree

    facing, _ = triangle_normals(vertices, triangles)
    _, triangle, place = TriangleTree(vertices, triangles).closest(points)
    row = np.flatnonzero(np.einsum("ij,ij->i", facing[triangle], normals) < AGAINST)
    if len(row) == 0:
        return triangle, place
    corners = vertices[triangles]
    middle = corners.mean(axis=1, keepdims=True)
    near = np.concatenate([middle, 0.5 * (middle + corners)], axis=1).reshape(-1, 3)
    both = np.concatenate([near, REACH * np.repeat(facing, 4, axis=0)], axis=1)
    at = np.concatenate([points[row], REACH * normals[row]], axis=1)
    _, found = cKDTree(both).query(at, CANDIDATES)
    best = np.full(len(row), np.inf)
    for column in range(CANDIDATES):
        other = found[:, column] // 4
        there = closest_on_triangles(points[row], corners[other])
        distance = ((there - points[row]) ** 2).sum(axis=1)
        better = np.einsum("ij,ij->i", facing[other], normals[row]) >= AGAINST
        better &= distance < best
        best[better] = distance[better]
        triangle[row[better]], place[row[better]] = other[better], there[better]
    return triangle, place


def vertex_errors(surface: NearSurface, vertices: Floats, triangles: Ints) -> tuple[Floats, Floats]:
    """The mean squared and the largest distance of the samples around each vertex, ``(V,)`` each.

    They are samples of the triangles at the vertex, and samples of the true surface near these.
    """
    total, share, largest = (np.zeros(len(vertices)) for _ in range(3))
    for way in (forward, backward):
        rows = way(surface, vertices, triangles)
        weight = rows.share[:, None] * rows.weights
        distance = np.repeat(np.abs(rows.distance(vertices))[:, None], 3, axis=1)
        square = distance**2
        for sums, values in ((total, weight * square), (share, weight)):
            sums += np.bincount(rows.corners.reshape(-1), values.reshape(-1), len(vertices))
        touching = rows.weights > 0
        np.maximum.at(largest, rows.corners[touching], distance[touching])
    return total / np.maximum(share, np.finfo(float).tiny), largest


def fit(mesh: Sized, surface: NearSurface, where: NDArray[np.bool_] | None = None) -> None:
    """Move the vertices so that the squared distances in both directions become least.

    Only vertices ``where (V,)`` move, by default all; vertices on creases stay.
    """
    blocks = []
    for way in (forward, backward):
        rows = way(surface, mesh.vertices, mesh.triangles)
        root = np.sqrt(rows.share)
        columns = 3 * rows.corners[:, :, None] + np.arange(3)
        values = root[:, None, None] * rows.gradient()
        blocks.append(Block.dense(columns, values, root * rows.distance(mesh.vertices)))
    free = np.repeat((mesh.rank == 0) if where is None else (mesh.rank == 0) & where, 3)
    move = GaussNewton(blocks, free, width=3).step(DAMPING).reshape(-1, 3)
    mesh.vertices = mesh.vertices + limited(move, LONGEST_STEP * mesh.length)
