"""What can be told of a point cloud alone: its spacing, its noise, and points that lie out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...mesh.polygons import Floats

ASKED, PROBES = 20_000, 200
"""Points among which the noise is looked for, and places where it is."""
WIDE = 4.0
"""Radius of a fit, in standard deviations of the noise."""
LOW, UP = 25.0, 1.15
"""Of the fits' residuals this percentile, times this, is the noise: where two sheets are near to
each other residuals are too large, and most of the rest are a little too small."""
ROUNDS, SETTLED = 8, 0.03
NEIGHBOURS = 8
AROUND = 64
"""Points around one whose neighbours' distances are the usual ones there."""
PASSES = 8
"""Over the points: without its like, what is left of a thin cloud stands alone."""
ROUND = 0.1
"""Neighbours lie all around a point if the least of their variances is above this share of the
largest; on a surface they do not."""
SPARSE, SPARSE_HERE = 4.0, 3.0
"""Such a point is out if its neighbours are this many times as far as everywhere, or around."""
LONELY, LONELY_HERE = 4.0, 6.0
"""Any point is out if they are this many times as far as its neighbours' are, or around."""


def spacings(points: Floats, threads: int = 1) -> Floats:
    """Side of the square of surface that each of ``points (N, 3)`` has for itself, ``(N,)``."""
    from scipy.spatial import cKDTree

    count = min(7, len(points))
    far = cKDTree(points).query(points, count, workers=threads)[0][:, -1]
    return np.asarray(far * np.sqrt(np.pi / max(1, count - 1)))


def typical(spacings: Floats) -> float:
    """The spacing that half of the surface is sampled more finely than."""
    order = np.sort(spacings)
    area = np.cumsum(order**2)
    return float(order[np.searchsorted(area, 0.5 * area[-1])])


def noise(points: Floats, random: np.random.Generator) -> float:
    """Standard deviation of ``points (N, 3)`` about their surface: the residual of quadrics fitted
    within a radius of four times itself."""
    from scipy.spatial import cKDTree

    some = points[random.permutation(len(points))[:ASKED]]
    tree: Any = cKDTree(some)
    at = some[random.permutation(len(some))[:PROBES]]
    near = float(np.median(tree.query(at, min(13, len(some)))[0][:, -1]))
    found = 0.0
    for _ in range(ROUNDS):
        groups = tree.query_ball_point(at, max(WIDE * found, near))
        residuals = [_residual(some[group]) for group in groups if len(group) >= 12]
        if not residuals:
            break
        before, found = found, UP * float(np.percentile(residuals, LOW))
        if abs(found - before) < SETTLED * found:
            break
    return found


def _residual(points: Floats) -> float:
    """Root mean square distance of ``points (N, 3)`` to the quadric over their plane."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    height, u, v = (centred @ axes).T
    scale = max(float(np.abs(u).max()), float(np.abs(v).max()), np.finfo(float).tiny)
    u, v = u / scale, v / scale
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    left = height - terms @ np.linalg.lstsq(terms, height, rcond=None)[0]
    return float(np.sqrt(left @ left / max(1, len(points) - 6)))


def outliers(points: Floats, threads: int = 1) -> NDArray[np.bool_]:
    """Points that lie alone beside the others, or in a thin cloud away from them, ``(N,)``."""
    from scipy.spatial import cKDTree

    out = np.zeros(len(points), dtype=bool)
    left = np.arange(len(points))
    for _ in range(PASSES):
        if len(left) <= AROUND:
            break
        here = points[left]
        tree = cKDTree(here)
        distance, near = tree.query(here, NEIGHBOURS + 1, workers=threads)
        far = distance[:, -1]
        middle = np.median(far)
        # The others are where the cloud is dense.
        asked = np.flatnonzero(far > 0.5 * SPARSE_HERE * middle)
        if len(asked) == 0:
            break
        usual = np.median(far[tree.query(here[asked], AROUND, workers=threads)[1]], axis=1)
        around = here[near[asked]]
        around = around - around.mean(axis=1, keepdims=True)
        variance = np.linalg.eigvalsh(around.transpose(0, 2, 1) @ around)
        all_around = variance[:, 0] > ROUND * variance[:, 2]
        apart = far[asked]
        lonely = (apart > LONELY * np.median(far[near[asked, 1:]], axis=1)) | (
            apart > LONELY_HERE * usual
        )
        lonely |= all_around & ((apart > SPARSE * middle) | (apart > SPARSE_HERE * usual))
        if not lonely.any():
            break
        out[left[asked[lonely]]] = True
        left = left[~out[left]]
    return out
