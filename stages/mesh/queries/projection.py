"""Closest points of a triangle surface, for many points at once."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import sample_triangles, triangle_normals
from ..polygons import Floats, Ints

if TYPE_CHECKING:
    from .triangle_tree import TriangleTree

SAMPLES = 60_000
"""Number of random samples of the surface. The centroid of each triangle is a further sample."""
CANDIDATES = 4
"""Number of samples whose triangles are tried if the closest triangle faces the wrong side."""
AGAINST = -0.2
"""A triangle faces the wrong side if the cosine of its normal and the given one is less."""


class ClosestPoint:
    """Exact closest points, found with a tree of bounding boxes.

    ``samples (S, 3)`` lie on the triangles ``owner (S,)``, which have ``corners (T, 3, 3)`` and
    unit ``normals (T, 3)``. If only one of several sheets is wanted, samples are compared by
    position and normal: a difference of 1 in the normal counts like the distance ``reach``.
    """

    def __init__(self, vertices: Floats, triangles: Ints, reach: float, threads: int = 1) -> None:
        normals, area = triangle_normals(vertices, triangles)
        solid = area > 0
        self.vertices = np.ascontiguousarray(vertices)
        self.triangles = np.ascontiguousarray(triangles[solid])
        self.corners = self.vertices[self.triangles]
        self.normals = normals[solid]
        # With a fixed seed the samples depend on the mesh only.
        samples, owner = sample_triangles(
            vertices, self.triangles, SAMPLES, np.random.default_rng(0)
        )
        self.owner = np.concatenate([owner, np.arange(len(self.corners))])
        self.samples = np.concatenate([samples, self.corners.mean(axis=1)])
        self.reach, self.threads = reach, threads

    @property
    def sample_normals(self) -> Floats:
        """Unit normals at the samples, ``(S, 3)``."""
        return np.asarray(self.normals[self.owner])

    def keep(self, wanted: NDArray[np.bool_], turned: NDArray[np.bool_]) -> None:
        """Remove the samples that are not ``wanted (S,)``, and the triangles that lose all samples.

        The normals of triangles with a ``turned (S,)`` sample are reversed.
        """
        flip = np.zeros(len(self.normals), dtype=bool)
        flip[self.owner[turned]] = True
        self.normals = np.where(flip[:, None], -self.normals, self.normals)
        self.samples, self.owner = self.samples[wanted], self.owner[wanted]
        kept = np.unique(self.owner)
        number = np.zeros(len(self.normals), dtype=np.int64)
        number[kept] = np.arange(len(kept))
        self.owner = number[self.owner]
        self.triangles, self.corners = self.triangles[kept], self.corners[kept]
        self.normals = self.normals[kept]
        for tree in ("tree", "facing"):
            self.__dict__.pop(tree, None)

    @cached_property
    def tree(self) -> TriangleTree:
        """The tree of the triangles."""
        from .triangle_tree import TriangleTree  # numba, which it needs, is large

        return TriangleTree(self.vertices, self.triangles, self.threads)

    @cached_property
    def facing(self) -> Any:
        """A tree of the samples by position and normal, ``(S, 6)``."""
        from scipy.spatial import cKDTree

        return cKDTree(np.concatenate([self.samples, self.reach * self.sample_normals], axis=1))

    def locate(self, points: Floats) -> tuple[Floats, Ints]:
        """The closest points ``(N, 3)`` on all triangles, and their triangles ``(N,)``."""
        _, triangle, closest = self.tree.closest(points)
        return closest, triangle

    def __call__(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """The closest points ``(N, 3)`` and the unit normals of their triangles.

        With ``normals (N, 3)``, a closest triangle that faces the wrong side is replaced by the
        closest of the CANDIDATES samples' triangles that does not, if there is one.
        """
        closest, triangle = self.locate(points)
        if normals is None:
            return closest, self.normals[triangle]
        against = np.einsum("ij,ij->i", self.normals[triangle], normals) < AGAINST
        row = np.flatnonzero(against)
        if len(row):
            at = np.concatenate([points[row], self.reach * normals[row]], axis=1)
            _, near = self.facing.query(at, CANDIDATES, workers=self.threads)
            best = np.full(len(row), np.inf)
            for column in range(near.shape[1]):
                other = self.owner[near[:, column]]
                found = closest_on_triangles(points[row], self.corners[other])
                distance = ((found - points[row]) ** 2).sum(axis=1)
                facing = np.einsum("ij,ij->i", self.normals[other], normals[row]) >= AGAINST
                better = facing & (distance < best)
                best[better] = distance[better]
                closest[row[better]], triangle[row[better]] = found[better], other[better]
        return closest, self.normals[triangle]


def closest_on_triangles(points: Floats, corners: Floats) -> Floats:
    """The point ``(N, 3)`` of each triangle ``corners (N, 3, 3)`` that is closest
    to ``points (N, 3)``."""
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
