"""The target edge length as a function on a surface.

It is shorter where the shape is thin, where creases are close to each other, or where triangles are
far from the true surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..mesh.polygons import Floats, Ints

OPPOSITE = -0.5
"""Normals with a smaller cosine belong to opposite sheets."""
ACROSS = 0.6
"""The line between two points goes from sheet to sheet if its cosine with
both normals is larger."""
BETWEEN = 0.5
"""The line between two points goes from crease to crease if its cosine with
both tangents is smaller."""
THINNEST = 0.6
"""Largest edge, divided by the thickness of the shape or by the distance of two creases."""
CELL = np.sqrt(3) / 4
"""Area of an equilateral triangle, divided by its squared edge."""
GRADATION = 0.35
"""Largest growth of the target length per length."""
NEIGHBOURS = 8
"""Number of nearest points with which the growth is limited."""
MOST_PAIRS = 2e7
"""Largest number of pairs of points that are compared. The distance limit is
lowered if there are more."""
EVEN = 1 / 6
"""Exponent by which errors change lengths. The squared error over a triangle grows with the sixth
power of its edges, and for a given number of triangles the sum is least if all errors are equal."""
STRONGEST = 3.0
"""Largest factor by which a length changes after one measurement of the errors."""


def thickness(points: Floats, normals: Floats, limit: float) -> Floats:
    """The distance ``(N,)`` from each sample of a surface to the opposite sheet, inside or outside.

    ``points (N, 3)`` and ``normals (N, 3)`` are the samples. The distance is infinite where it
    would exceed ``limit``.
    """
    result = np.full(len(points), np.inf)
    pairs = _pairs(points, limit)
    if len(pairs) == 0:
        return result
    facing = np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) < OPPOSITE
    pairs = pairs[facing]
    way = points[pairs[:, 1]] - points[pairs[:, 0]]
    distance = np.linalg.norm(way, axis=1)
    for side in range(2):
        height = np.einsum("ij,ij->i", way, normals[pairs[:, side]])
        distance = np.where(np.abs(height) > ACROSS * np.linalg.norm(way, axis=1), distance, np.inf)
    np.minimum.at(result, pairs[:, 0], distance)
    np.minimum.at(result, pairs[:, 1], distance)
    return result


def separation(points: Floats, tangents: Floats, limit: float) -> Floats:
    """The distance ``(N,)`` from each sample of a crease to another crease beside it.

    Another part of the same crease counts too. ``points (N, 3)`` and ``tangents (N, 3)`` are the
    samples. The distance is infinite where it would exceed ``limit``.
    """
    result = np.full(len(points), np.inf)
    pairs = _pairs(points, limit)
    if len(pairs) == 0:
        return result
    way = points[pairs[:, 1]] - points[pairs[:, 0]]
    distance = np.linalg.norm(way, axis=1)
    across = distance > 0
    for side in range(2):
        along = np.einsum("ij,ij->i", way, tangents[pairs[:, side]])
        across &= np.abs(along) < BETWEEN * distance
    for side in range(2):
        np.minimum.at(result, pairs[across, side], distance[across])
    return result


def _pairs(points: Floats, limit: float) -> Ints:
    """The pairs ``(K, 2)`` of points within ``limit``, which is lowered if there are
    more than MOST_PAIRS."""
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(points)
    while tree.count_neighbors(tree, limit) > MOST_PAIRS:
        limit *= 0.8
    return np.asarray(tree.query_pairs(limit, output_type="ndarray"))


def triangles_of(area: float, lengths: Floats) -> float:
    """The number of triangles that cover ``area`` if their edges at even samples
    are ``lengths (N,)``."""
    return float(area / CELL * (1 / lengths**2).mean())


class LengthField:
    """A target length at points of a surface. Elsewhere, the nearest point decides."""

    def __init__(self, points: Floats, lengths: Floats) -> None:
        from scipy.spatial import cKDTree

        self.tree: Any = cKDTree(points)
        distance, near = self.tree.query(points, NEIGHBOURS)
        self.edges: tuple[Ints, Ints, Floats] = (
            np.repeat(np.arange(len(points)), NEIGHBOURS),
            near.reshape(-1),
            GRADATION * distance.reshape(-1),
        )
        self.lengths = self.graded(lengths)
        self.metrics: Floats | None = None
        """The metric at each point ``(N, 3, 3)`` in which lengths are measured."""

    def graded(self, lengths: Floats) -> Floats:
        """The largest lengths that do not exceed ``lengths (N,)`` and grow by at most GRADATION."""
        here, there, rise = self.edges
        lengths = lengths.copy()
        while True:
            before = lengths.copy()
            np.minimum.at(lengths, here, before[there] + rise)
            np.minimum.at(lengths, there, before[here] + rise)
            if (before - lengths).max() <= 1e-3 * before.min():
                return lengths

    def __call__(self, points: Floats) -> Floats:
        """The target lengths ``(K,)`` at ``points (K, 3)``."""
        return np.asarray(self.lengths[self.nearest(points)])

    def metric(self, points: Floats) -> Floats:
        """The metric ``(K, 3, 3)`` at ``points (K, 3)``."""
        assert self.metrics is not None
        return np.asarray(self.metrics[self.nearest(points)])

    def nearest(self, points: Floats) -> Ints:
        return np.asarray(self.tree.query(points)[1])


def evened(lengths: Floats, errors: Floats) -> Floats:
    """Lengths ``(V,)`` at which all triangles would have the same squared error.

    ``errors (V,)`` are mean squared errors of triangles with the present ``lengths (V,)``. No
    length changes by more than the factor STRONGEST.
    """
    each = errors * lengths**2
    mean = each.mean()
    if not mean > 0:
        return lengths
    factor = (mean / np.maximum(each, np.finfo(float).tiny)) ** EVEN
    return np.asarray(lengths * np.clip(factor, 1 / STRONGEST, STRONGEST))
