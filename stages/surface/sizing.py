"""The target edge length over a surface: a base length, finer where the shape is thin."""

from __future__ import annotations

from typing import Any

import numpy as np

from .polygons import Floats, Ints

OPPOSITE = -0.5
"""Cosine of two normals below which they are of opposite sheets."""
ACROSS = 0.6
"""Cosine to both normals above which the way between two points leads across a sheet."""
THINNEST = 0.6
"""Edge of a triangle, or of a voxel, over the thickness that it still resolves."""
SMALLEST = 0.25
"""The least target length, in units of the largest."""
GRADATION = 0.35
"""How much the target length may grow per length."""
NEIGHBOURS = 8


def thickness(points: Floats, normals: Floats, limit: float) -> Floats:
    """Distance ``(N,)`` from each surface sample to the opposite sheet, inside or outside.

    ``points, normals (N, 3)`` sample a surface. Sheets further than ``limit`` are not seen: the
    value there is infinity.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    pairs: Any = tree.query_pairs(limit, output_type="ndarray")
    result = np.full(len(points), np.inf)
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


def for_surface(points: Floats, normals: Floats, length: float) -> LengthField:
    """``length`` everywhere but where the shape or a gap is thin; ``points, normals (N, 3)``."""
    thin = thickness(points, normals, length / THINNEST)
    return LengthField(points, np.clip(THINNEST * thin, SMALLEST * length, length))


class LengthField:
    """A target length at samples of a surface, extended to its neighbourhood."""

    def __init__(self, points: Floats, lengths: Floats) -> None:
        from scipy.spatial import cKDTree

        self.tree: Any = cKDTree(points)
        distance, near = self.tree.query(points, NEIGHBOURS)
        self.edges: tuple[Ints, Ints, Floats] = (
            np.repeat(np.arange(len(points)), NEIGHBOURS),
            near.reshape(-1),
            GRADATION * distance.reshape(-1),
        )
        self.lengths = self._graded(lengths)

    def _graded(self, lengths: Floats) -> Floats:
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
        return np.asarray(self.lengths[self.tree.query(points)[1]])
