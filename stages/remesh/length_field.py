"""The target edge length over a surface: what is asked for, finer where the shape is thin, creases
are close to each other, or triangles are far from the surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..mesh.polygons import Floats, Ints

OPPOSITE = -0.5
"""Cosine of two normals below which they are of opposite sheets."""
ACROSS = 0.6
"""Cosine to both normals above which the way between two points leads across a sheet."""
BETWEEN = 0.5
"""Cosine to both tangents below which the way between two points leads from crease to crease."""
THINNEST = 0.6
"""Edge of a voxel over the thickness that it still resolves, and of a triangle over the distance of
two creases."""
CELL = np.sqrt(3) / 4
"""Area of a triangle over its squared edge length."""
GRADATION = 0.35
"""How much the target length may grow per length."""
NEIGHBOURS = 8
MOST_PAIRS = 2e7
"""Of points that are looked at for sheets and creases opposite; the reach is less where there would
be more."""
EVEN = 1 / 6
"""The squared error over a triangle grows with the sixth power of its edge length, and the sum over
a number of triangles is least where each has the same."""
STRONGEST = 3.0
"""Factor by which one look at the errors changes a length at the most."""


def thickness(points: Floats, normals: Floats, limit: float) -> Floats:
    """Distance ``(N,)`` from each surface sample to the opposite sheet, inside or outside.

    ``points, normals (N, 3)`` sample a surface. Sheets further than ``limit`` are not seen: the
    value there is infinity.
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
    """Distance ``(N,)`` from each point of a crease to the next crease, or the other side of its
    own, across; infinity beyond ``limit``. ``points, tangents (N, 3)`` sample the creases."""
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
    """Pairs ``(K, 2)`` of points within ``limit``, or within less where that were too many."""
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(points)
    while tree.count_neighbors(tree, limit) > MOST_PAIRS:
        limit *= 0.8
    return np.asarray(tree.query_pairs(limit, output_type="ndarray"))


def triangles_of(area: float, lengths: Floats) -> float:
    """How many triangles an ``area`` takes whose edges are ``lengths (N,)`` at even samples."""
    return float(area / CELL * (1 / lengths**2).mean())


class LengthField:
    """A target length at points of a surface, extended to their neighbourhood."""

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
        """At the points ``(N, 3, 3)``: what lengths are measured in."""

    def graded(self, lengths: Floats) -> Floats:
        """The largest lengths below ``lengths`` that grow by GRADATION at the most."""
        here, there, rise = self.edges
        lengths = lengths.copy()
        while True:
            before = lengths.copy()
            np.minimum.at(lengths, here, before[there] + rise)
            np.minimum.at(lengths, there, before[here] + rise)
            if (before - lengths).max() <= 1e-3 * before.min():
                return lengths

    def __call__(self, points: Floats) -> Floats:
        return np.asarray(self.lengths[self.nearest(points)])

    def metric(self, points: Floats) -> Floats:
        assert self.metrics is not None
        return np.asarray(self.metrics[self.nearest(points)])

    def nearest(self, points: Floats) -> Ints:
        return np.asarray(self.tree.query(points)[1])


def evened(lengths: Floats, errors: Floats) -> Floats:
    """Lengths ``(V,)`` in proportion to which each triangle would have the same squared error, from
    present ones and the mean squared ``errors`` of triangles there."""
    each = errors * lengths**2
    mean = each.mean()
    if not mean > 0:
        return lengths
    factor = (mean / np.maximum(each, np.finfo(float).tiny)) ** EVEN
    return np.asarray(lengths * np.clip(factor, 1 / STRONGEST, STRONGEST))
