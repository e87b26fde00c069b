"""The wanted sizes of cells as a function of the distance to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...mesh.geometry import fan_triangles
from ...mesh.polygons import Floats, PolygonMesh
from ...mesh.queries.projection import ClosestPoint
from .interior import Guard

NODES = 400_000
"""Approximate number of nodes of the grid that stores the distance to the surface."""


@dataclass(frozen=True)
class Grid:
    """Values at the nodes ``(X, Y, Z)`` of a grid, linear between them."""

    values: Floats
    origin: Floats
    spacing: float


@dataclass(frozen=True)
class Sizes:
    """Wanted sizes of cells (cube roots of their volumes) inside a surface: ``least + growth d`` at
    depth d, at most ``most``. In model units."""

    least: float
    growth: float
    most: float
    depth: Grid
    """Distance to the surface, negative outside."""

    @cached_property
    def wanted(self) -> Floats:
        """The wanted sizes at the nodes of the grid."""
        return np.minimum(self.least + self.growth * np.maximum(self.depth.values, 0), self.most)

    def density(self) -> Grid:
        """A density whose centroidal tessellation has cells of the wanted sizes, up to a common
        factor.

        Sizes go as the fifth root of the inverse density (Gersho; Du, Faber and Gunzburger 1999).
        """
        values = np.ascontiguousarray((self.wanted / self.wanted.min()) ** -5)
        return Grid(values, self.depth.origin, self.depth.spacing)

    def count(self, layer: float) -> float:
        """The number of cells that fill the part deeper than ``layer``."""
        deep = self.depth.values > layer
        return float((self.wanted[deep] ** -3).sum() * self.depth.spacing**3)

    def places(self, random: np.random.Generator, count: int) -> Floats:
        """Random points ``(count, 3)``, with the density of the wanted cells."""
        inside = np.flatnonzero(self.depth.values.reshape(-1) > -self.depth.spacing)
        total = np.cumsum(self.wanted.reshape(-1)[inside] ** -3)
        node = inside[np.searchsorted(total, random.random(count) * total[-1], side="right")]
        index = np.stack(np.unravel_index(node, self.depth.values.shape), axis=1)
        within = index + random.random((count, 3)) - 0.5
        return np.asarray(self.depth.origin + self.depth.spacing * within)


def depths(surface: PolygonMesh, guard: Guard, threads: int) -> Grid:
    """Distances to ``surface`` on a grid around it. A node is inside if the nearest generator is
    inside."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    spacing = float(np.cbrt(np.prod(high - low) / NODES))
    nodes = [
        at + spacing * np.arange(int(np.ceil((end - at) / spacing)) + 1)
        for at, end in zip(low, high, strict=True)
    ]
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3)
    vertices, triangles, _ = fan_triangles(surface)
    closest, _ = ClosestPoint(vertices, triangles, 1.0, threads).locate(flat)
    sign = np.where(guard.inside[guard.tree.query(flat, workers=threads)[1]], 1.0, -1.0)
    distance = sign * np.linalg.norm(flat - closest, axis=1)
    return Grid(distance.reshape(points.shape[:3]), low, spacing)
