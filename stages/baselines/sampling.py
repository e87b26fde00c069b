"""Even samples of a surface: of many at random, those that are not too near to one before."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import compiled
from ..mesh.polygons import Floats

DRAWN = 3
"""How many samples are drawn for each that is wanted."""


@compiled
def _drop(pairs: Any, kept: Any) -> None:
    """Of each of ``pairs (P, 2)``, sorted, the second goes unless the first is gone already."""
    for pair in range(len(pairs)):
        if kept[pairs[pair, 0]]:
            kept[pairs[pair, 1]] = False


def even(points: Floats, count: int, threads: int) -> Floats:
    """At most ``count`` of ``points (N, 3)``, which are uniform by area, with a gap between them.

    The gap is the r with one point in every r^2: the mean squared distance from a point to the
    nearest other one is r^2 / pi, whatever the area. Points are taken in the order given.
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
