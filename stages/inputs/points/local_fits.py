"""Quadrics fitted to the points of a noisy cloud around places of its surface."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...mesh.polygons import Floats

REACH = 2.5
"""Standard deviations of the window within which points count."""
THICK = 2.5
"""Standard deviations of the noise within which points count."""
OUTLYING = 4.0
"""Standard deviations of the residual from which a point does not count."""
REFITS = 2
"""Fits, each without what lies out of the one before."""
STIFF = 1e-2
"""How much bending is held back, as a share of the points' weight."""
WINDOW = 1.5
"""Standard deviation of the window, in spacings of the cloud, at least."""
BLUR, BLUR_SPARSE = 0.7, 1.2
"""Standard deviation of the window, in standard deviations of the noise: the first where there are
points enough, the second where they are few."""
ENOUGH = 4.5
"""Standard deviation of a window that holds points enough, in spacings."""
FEWEST, MOST = 24, 1000
"""Points that are looked at for one fit."""
AT_ONCE = 60_000
"""Points of fits computed together: what a cache holds."""


@dataclass(frozen=True)
class Fits:
    """Of quadrics over the tangent planes at ``N`` places."""

    height: Floats
    """Of the quadric over each place, along its normal."""
    bend: Floats
    """Its mean curvature as a graph: half its Laplacian, negative where the shape is convex."""
    weight: Floats
    """Points that counted."""
    residual: Floats
    """Root mean square distance of the points from it."""


@dataclass(frozen=True)
class Cloud:
    """``points (N, 3)`` with outward unit ``normals``, each for ``weights (N,)`` of them."""

    points: Floats
    normals: Floats
    weights: Floats
    threads: int = 1

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def fits(self, places: Floats, normals: Floats, noise: float, spacing: Floats) -> Fits:
        """Around ``places (N, 3)`` with unit ``normals``, by least squares, points of other sheets
        left out by their normals, and what lies out by its residual; ``spacing (N,)`` is that of
        the cloud."""
        window = np.clip(ENOUGH * spacing, BLUR * noise, BLUR_SPARSE * noise)
        window = np.maximum(window, WINDOW * spacing)
        height = THICK * noise + window
        radius = np.hypot(REACH * window, height)
        some = np.linspace(0, len(places) - 1, min(len(places), 400)).astype(int)
        count = self.tree.query_ball_point(
            places[some], radius[some], workers=self.threads, return_length=True
        )
        near = int(np.clip(np.percentile(count, 90), FEWEST, MOST))
        near = min(near, len(self.points))
        step = max(1, AT_ONCE // near)
        starts = range(0, len(places), step)
        with ThreadPoolExecutor(self.threads) as pool:
            parts = pool.map(
                lambda start: self._fit(
                    places[start : start + step],
                    normals[start : start + step],
                    window[start : start + step],
                    height[start : start + step],
                    near,
                ),
                starts,
            )
            return Fits(*np.concatenate(list(parts), axis=1))

    def _fit(
        self, places: Floats, normals: Floats, window: Floats, height: Floats, near: int
    ) -> Floats:
        _, index = self.tree.query(places, near)
        way = self.points[index] - places[:, None]
        side = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(normals, side)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(normals, first), normals], axis=2)
        local = way @ axes
        u, v = local[..., 0] / window[:, None], local[..., 1] / window[:, None]
        above = local[..., 2]
        facing = (self.normals[index] @ normals[:, :, None])[..., 0]
        square = u * u + v * v
        given = self.weights[index] * np.exp(-0.5 * square) * np.maximum(facing, 0.0)
        given *= (square < REACH**2) & (np.abs(above) < height[:, None])
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        stiff = np.diag([0.0, 1e-4, 1e-4, STIFF, STIFF, STIFF]) + 1e-9 * np.eye(6)
        weight = given
        for _ in range(REFITS):
            total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
            weighed = terms * (weight / total[:, None])[:, None]
            found = np.linalg.solve(
                weighed @ terms.transpose(0, 2, 1) + stiff, weighed @ above[..., None]
            )
            error = above - (found.transpose(0, 2, 1) @ terms)[:, 0]
            residual = np.sqrt((weight * error**2).sum(axis=1) / total)
            out = OUTLYING * np.maximum(residual, 1e-9)[:, None]
            weight = given * np.maximum(1 - (error / out) ** 2, 0.0) ** 2
        # Six coefficients make the points' distances less than their noise.
        count = total**2 / np.maximum((weight**2).sum(axis=1), np.finfo(float).tiny)
        residual *= np.sqrt(1 / np.maximum(1 - 6 / np.maximum(count, 6.0), 0.25))
        bend = (found[:, 3, 0] + found[:, 5, 0]) / window**2
        return np.stack([found[:, 0, 0], bend, weight.sum(axis=1), residual])
