"""The inside of a point cloud without normals, as the level set of a function on a grid.

A winding number is the potential of dipoles on the surface. Regularised parametric Gauss
reconstruction (Lin et al. 2022) finds the least dipoles whose potential is a half at the points; of
these, winding-number consistency (Lin et al. 2024) makes unit normals that agree with the gradient
of their own potential. Both need nothing but solutions of Poisson's equation on a box.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter

from ...mesh.polygons import Floats

PADDING = 0.1
"""Of the longest side, on every side of the points, to where the potential is zero."""
NARROWEST = 0.75
"""Width of a dipole, in edges of the grid, at least."""
RIDGE = 0.03
"""Of the operator's largest eigenvalue: what keeps dipoles small."""
ENOUGH, MOST = 1e-3, 60
"""Relative residual that ends the conjugate gradients, and the most iterations."""
POWERS = 6
"""Iterations for the largest eigenvalue."""
FADES = 0.05
"""Of the usual density of points: where fewer are near, the level is the cloud's."""

Single = NDArray[np.float32]
"""Potentials: single precision is a thousandth of what points in a cell differ by."""


@dataclass(frozen=True)
class Grid:
    """Nodes ``origin + spacing * (i, j, k)``, ``shape`` of them, around a cloud."""

    origin: Floats
    spacing: float
    shape: tuple[int, ...]
    threads: int = 1

    @staticmethod
    def around(points: Floats, spacing: float, threads: int = 1) -> Grid:
        low, high = points.min(axis=0), points.max(axis=0)
        margin = PADDING * float((high - low).max())
        counts = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
        # The sine transform of n values is fast where 2 n + 2 has small factors only.
        fast = [fft.next_fast_len(2 * (int(n) + 1), real=True) // 2 - 1 for n in counts]
        return Grid(low - margin, spacing, tuple(fast), threads)

    @cached_property
    def eigenvalues(self) -> Single:
        """Of minus the Laplacian, zero on the border, by sine wave."""
        axes = [
            2 * (1 - np.cos(np.pi * np.arange(1, n + 1) / (n + 1))) / self.spacing**2
            for n in self.shape
        ]
        total = axes[0][:, None, None] + axes[1][:, None] + axes[2]
        return np.asarray(total, np.float32)

    def poisson(self, width: float) -> Single:
        """By sine wave: the solution of Poisson's equation, blurred by a Gaussian of ``width``."""
        return np.asarray(np.exp(-0.5 * width**2 * self.eigenvalues) / self.eigenvalues)

    def solve(self, source: Single, response: Single) -> Single:
        transform: Any = fft.dstn(source, type=1, norm="ortho", workers=self.threads)
        transform *= response
        return np.asarray(
            fft.dstn(transform, type=1, norm="ortho", workers=self.threads, overwrite_x=True)
        )

    def interpolation(self, points: Floats) -> Any:
        """The sparse matrix of trilinear interpolation at ``points (N, 3)``, and its transpose."""
        from scipy.sparse import csr_array

        place = (points - self.origin) / self.spacing
        first = np.clip(np.floor(place).astype(np.int64), 0, np.array(self.shape) - 2)
        part = place - first
        columns, values = [], []
        for corner in np.ndindex(2, 2, 2):
            step = np.array(corner)
            columns.append(np.ravel_multi_index(tuple((first + step).T), self.shape))
            values.append(np.where(step == 1, part, 1 - part).prod(axis=1))
        count = len(points)
        matrix = csr_array(
            (
                np.stack(values, axis=1).reshape(-1).astype(np.float32),
                np.stack(columns, axis=1).reshape(-1).astype(np.int32),
                np.arange(0, 8 * count + 1, 8, dtype=np.int32),
            ),
            shape=(count, int(np.prod(self.shape))),
        )
        return matrix, matrix.T.tocsr()

    def slopes(self, field: Single, axis: int) -> Single:
        """Central differences; beyond the border the field is zero."""
        result = np.empty_like(field)
        given, out = np.moveaxis(field, axis, 0), np.moveaxis(result, axis, 0)
        np.subtract(given[2:], given[:-2], out=out[1:-1])
        out[0], out[-1] = given[1], -given[-2]
        result /= 2 * self.spacing
        return result

    def gradient(self, field: Single, interpolation: Any) -> Single:
        """Of ``field`` at the ``N`` points of the matrix ``interpolation``, ``(N, 3)``."""
        return np.stack(
            [interpolation @ self.slopes(field, axis).reshape(-1) for axis in range(3)], axis=1
        )


class Dipoles:
    """Dipoles at ``points (N, 3)`` of a grid, blurred by a Gaussian of ``width``; ``weights (N,)``
    say how much of the surface each stands for."""

    def __init__(self, grid: Grid, points: Floats, weights: Floats, width: float) -> None:
        self.grid = grid
        self.weights = np.asarray(weights, np.float32)
        self.at, self.to = grid.interpolation(points)
        self.response = grid.poisson(max(NARROWEST * grid.spacing, width))

    def potential(self, dipoles: Single) -> Single:
        """Of ``dipoles (N, 3)``, on the grid; outward ones make it high inside."""
        divergence: Any = 0.0
        for axis in range(3):
            spread = (self.to @ (self.weights * dipoles[:, axis])).reshape(self.grid.shape)
            divergence = divergence + self.grid.slopes(spread, axis)
        return self.grid.solve(divergence, self.response)

    def gradient(self, potential: Single) -> Single:
        """At the points, ``(N, 3)``."""
        return self.grid.gradient(potential, self.at)

    def values(self, potential: Single) -> Single:
        """At the points, ``(N,)``."""
        return np.asarray(self.at @ potential.reshape(-1))

    def least(self) -> Single:
        """The potential of the least dipoles with which it is a half at the points."""
        root = np.sqrt(self.weights)

        def dipoles(values: Single) -> Single:
            field = self.grid.solve(
                (self.to @ (root * values)).reshape(self.grid.shape), self.response
            )
            return -self.gradient(field)

        def operator(values: Single) -> Single:
            return root * self.values(self.potential(dipoles(values)))

        probe = np.random.default_rng(0).standard_normal(len(root)).astype(np.float32)
        largest = 0.0
        for _ in range(POWERS):
            probe /= np.linalg.norm(probe)
            moved = operator(probe)
            largest, probe = float(probe @ moved), moved
        ridge = np.float32(RIDGE * largest)
        found = np.zeros_like(root)
        residual = np.float32(0.5) * root
        way, square = residual.copy(), float(residual @ residual)
        goal = ENOUGH**2 * square
        for _ in range(MOST):
            if square <= goal:
                break
            moved = operator(way) + ridge * way
            step = np.float32(square / float(way @ moved))
            found += step * way
            residual -= step * moved
            before, square = square, float(residual @ residual)
            way = residual + np.float32(square / before) * way
        return self.potential(dipoles(found))

    def consistent(self, normals: Single, steps: int) -> tuple[Single, Single]:
        """The potential and the unit normals ``(N, 3)`` that it agrees with, after ``steps``."""
        potential = self.potential(normals)
        for _ in range(steps):
            normals = outward(self.gradient(potential))
            potential = self.potential(normals)
        return potential, normals

    def above_surface(self, potential: Single, width: float) -> Single:
        """How far the potential is above the level that passes through the points around, within
        ``width``; far from all points their median level."""
        values = self.values(potential)
        base = weighted_median(values, self.weights)
        # Points deep inside or far outside say nothing of the level.
        reach = min(float(np.ptp(potential[potential >= base])), base - float(potential.min()))
        trust = self.weights * np.maximum(1 - ((values - base) / max(reach, 1e-30)) ** 2, 0) ** 2
        blur = width / self.grid.spacing

        def spread(what: Any) -> Any:
            field = (self.to @ what.astype(np.float32)).reshape(self.grid.shape)
            return gaussian_filter(field, blur, mode="constant", truncate=3)

        near = spread(trust)
        usual = float(np.median(self.values(near)))
        level = base + spread(trust * (values - base)) / (near + FADES * usual)
        return np.asarray(potential - level, np.float32)


def outward(gradient: NDArray[Any]) -> NDArray[Any]:
    """Unit vectors against ``gradient (N, 3)``."""
    size = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.asarray(-gradient / np.maximum(size, np.finfo(np.float32).tiny))


def weighted_median(values: Any, weights: Any) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
