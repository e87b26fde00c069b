"""Evenly spaced samples of a surface: from many random samples, those too close
to others are removed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import compiled
from ..mesh.polygons import Floats

DRAWN = 3
"""Number of random samples for each sample of the result."""


@compiled
def _drop(pairs: Any, kept: Any) -> None:
    """For each of the sorted ``pairs (P, 2)``, remove the second point unless
    the first was removed."""
    for pair in range(len(pairs)):
        if kept[pairs[pair, 0]]:
            kept[pairs[pair, 1]] = False


def even(points: Floats, count: int, threads: int) -> Floats:
    """At most ``count`` of ``points (N, 3)`` with a smallest distance between them.

    The points must be uniform by area. The distance is the r for which there is one point in each
    area r^2: for random points, the mean squared distance to the nearest other point is r^2 / pi,
    whatever the area. Points are taken in the given order.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    nearest = tree.query(points, k=2, workers=threads)[0][:, 1]
    gap = float(np.sqrt(np.pi * (nearest**2).mean()))
    pairs = tree.query_pairs(gap, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    kept = np.ones(len(points), dtype=bool)
    _drop(pairs, kept)
    return points[kept][:count]
