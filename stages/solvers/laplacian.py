"""The graph Laplacian of a surface, as residuals of spheres that are stored as ``(V, 4)``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.polygons import Floats, Ints
from .least_squares import Block


@dataclass(frozen=True)
class Laplacian:
    """The map from values at vertices to their differences from the mean over their neighbours.

    ``rows``, ``columns`` and ``entries``, ``(N,)`` each, are its sparse matrix.
    """

    count: int
    rows: Ints
    columns: Ints
    entries: Floats

    @classmethod
    def of(cls, ends: Ints, count: int) -> Laplacian:
        """The Laplacian of the graph with edges ``ends (E, 2)`` and ``count`` vertices."""
        start, end = np.concatenate([ends, ends[:, ::-1]]).T
        share = 1 / np.maximum(np.bincount(start, minlength=count), 1)
        here = np.arange(count)
        return cls(
            count,
            np.concatenate([here, start]),
            np.concatenate([here, end]),
            np.concatenate([np.ones(count), -share[start]]),
        )

    def __call__(self, values: Floats) -> Floats:
        """The Laplacian ``(V, k)`` of ``values (V, k)``."""
        part = self.entries[:, None] * values[self.columns]
        return np.stack([np.bincount(self.rows, p, minlength=self.count) for p in part.T], axis=1)

    def along(self, normal: Floats, scale: Floats, residual: Floats) -> Block:
        """``scale (V,)`` times the tangential part of the centres' Laplacian,
        for normals ``(V, 3)``."""
        at = normal[self.rows]
        values = np.eye(3) - at[:, :, None] * at[:, None]
        values *= (scale[self.rows] * self.entries)[:, None, None]
        axis = np.arange(3)
        columns = np.broadcast_to(4 * self.columns[:, None, None] + axis, values.shape)
        rows = np.broadcast_to(3 * self.rows[:, None, None] + axis[:, None], values.shape)
        return Block(rows.reshape(-1), columns.reshape(-1), values.reshape(-1), residual)

    def across(self, normal: Floats, scale: Floats, residual: Floats) -> Block:
        """``scale (V,)`` times the normal part of the centres' Laplacian,
        for normals ``(V, 3)``."""
        values = (scale[self.rows] * self.entries)[:, None] * normal[self.rows]
        columns = 4 * self.columns[:, None] + np.arange(3)
        return Block(np.repeat(self.rows, 3), columns.reshape(-1), values.reshape(-1), residual)

    def radii(self, scale: Floats, residual: Floats) -> Block:
        """The Laplacian of ``scale (V,)`` times the radii."""
        return Block(self.rows, 4 * self.columns + 3, self.entries * scale[self.columns], residual)
