"""Closest points of a triangle surface, for many points at once."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface.geometry import sample_triangles
from ..surface.polygons import Floats, Ints

SAMPLES = 60_000
"""Points on the surface whose triangles are tried, beside the centroid of every triangle."""
CANDIDATES = 4
"""Nearest samples whose triangles are tried."""
AGAINST = -0.2
"""A triangle whose normal has a smaller cosine with the one asked for is of another sheet."""


class ClosestPoint:
    """Closest points on the triangles of the nearest of many samples of a surface.

    ``samples (S, 3)`` lie on triangles ``owner (S,)`` with ``corners (T, 3, 3)`` and unit
    ``normals (T, 3)``. ``reach`` is the distance that a turn of a normal by one radian counts for.
    """

    def __init__(self, vertices: Floats, triangles: Ints, reach: float, threads: int = 1) -> None:
        corners = vertices[triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(cross, axis=1)
        solid = size > 0
        self.corners = corners[solid]
        self.normals = cross[solid] / size[solid, None]
        # The samples only find candidates: a fixed seed keeps the result a function of the mesh.
        samples, owner = sample_triangles(
            vertices, triangles[solid], SAMPLES, np.random.default_rng(0)
        )
        self.owner = np.concatenate([owner, np.arange(len(self.corners))])
        self.samples = np.concatenate([samples, self.corners.mean(axis=1)])
        self.reach, self.threads = reach, threads

    @property
    def sample_normals(self) -> Floats:
        """Unit normals at the samples, ``(S, 3)``."""
        return np.asarray(self.normals[self.owner])

    def keep(self, wanted: NDArray[np.bool_], turned: NDArray[np.bool_]) -> None:
        """Leave out the samples that are not ``wanted (S,)``; turn the normals of the triangles
        with ``turned (S,)`` samples."""
        flip = np.zeros(len(self.normals), dtype=bool)
        flip[self.owner[turned]] = True
        self.normals = np.where(flip[:, None], -self.normals, self.normals)
        self.samples, self.owner = self.samples[wanted], self.owner[wanted]
        for tree in ("tree", "facing"):
            self.__dict__.pop(tree, None)

    @cached_property
    def tree(self) -> Any:
        """Over the samples."""
        from scipy.spatial import cKDTree

        return cKDTree(self.samples)

    @cached_property
    def facing(self) -> Any:
        """Over the samples and their normals."""
        from scipy.spatial import cKDTree

        return cKDTree(np.concatenate([self.samples, self.reach * self.sample_normals], axis=1))

    def __call__(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """Closest points ``(N, 3)`` and the unit normals of their triangles.

        With ``normals (N, 3)`` triangles that face the other way count only if no other is near.
        """
        _, near = self.tree.query(points, CANDIDATES, workers=self.threads)
        if normals is not None:
            at = np.concatenate([points, self.reach * normals], axis=1)
            _, same = self.facing.query(at, CANDIDATES, workers=self.threads)
            near = np.concatenate([near, same], axis=1)
        best = np.full(len(points), np.inf)
        closest, direction = np.zeros_like(points), np.zeros_like(points)
        for column in range(near.shape[1]):
            triangle = self.owner[near[:, column]]
            found = closest_on_triangles(points, self.corners[triangle])
            distance = ((found - points) ** 2).sum(axis=1)
            if normals is not None:
                against = np.einsum("ij,ij->i", self.normals[triangle], normals) < AGAINST
                distance = np.where(against, 1e6 * (distance + np.finfo(float).tiny), distance)
            better = distance < best
            best[better] = distance[better]
            closest[better], direction[better] = found[better], self.normals[triangle[better]]
        return closest, direction


def closest_on_triangles(points: Floats, corners: Floats) -> Floats:
    """The point of triangle ``corners (N, 3, 3)`` closest to ``points (N, 3)``, row by row."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", points - a, normal) / np.maximum(square, np.finfo(float).tiny)
    flat = points - height[:, None] * normal
    within = np.ones(len(points), dtype=bool)
    best = np.full(len(points), np.inf)
    result = flat.copy()
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        within &= np.einsum("ij,ij->i", np.cross(side, flat - start), normal) >= 0
        length = np.maximum(np.einsum("ij,ij->i", side, side), np.finfo(float).tiny)
        along = np.clip(np.einsum("ij,ij->i", points - start, side) / length, 0, 1)
        at = start + along[:, None] * side
        distance = ((points - at) ** 2).sum(axis=1)
        nearer = distance < best
        best[nearer], result[nearer] = distance[nearer], at[nearer]
    result[within] = flat[within]
    return np.asarray(result)
