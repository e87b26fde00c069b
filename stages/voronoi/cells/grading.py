"""Target sizes of cells as a function of the distance to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...mesh.geometry import fan_triangles
from ...mesh.polygons import Floats, PolygonMesh
from ...mesh.queries.projection import ClosestPoint
from .interior import Guard

NODES = 400_000
"""Approximate number of nodes of the grid on which the distance to the surface is stored."""


@dataclass(frozen=True)
class Grid:
    """Values at the nodes ``(X, Y, Z)`` of a grid, interpolated linearly."""

    values: Floats
    origin: Floats
    spacing: float


@dataclass(frozen=True)
class Sizes:
    """Target sizes of cells, in model units. A size is the cube root of a volume.

    At depth d below the surface the size is ``least + growth d``, but at most ``most``.
    """

    least: float
    growth: float
    most: float
    depth: Grid
    """Distance to the surface, negative outside."""

    @cached_property
    def wanted(self) -> Floats:
        """The target sizes at the nodes of the grid."""
        return np.minimum(self.least + self.growth * np.maximum(self.depth.values, 0), self.most)

    def density(self) -> Grid:
        """A density for which the cells of a centroidal tessellation have the target sizes, up to a
        factor.

        The size of such cells is proportional to the density to the power -1/5 (Gersho 1979; Du,
        Faber and Gunzburger 1999).
        """
        values = np.ascontiguousarray((self.wanted / self.wanted.min()) ** -5)
        return Grid(values, self.depth.origin, self.depth.spacing)

    def count(self, layer: float) -> float:
        """The number of cells of these sizes that fill the part deeper than ``layer``."""
        deep = self.depth.values > layer
        return float((self.wanted[deep] ** -3).sum() * self.depth.spacing**3)

    def places(self, random: np.random.Generator, count: int) -> Floats:
        """``count`` random points ``(count, 3)``, as dense as cells of the target sizes."""
        inside = np.flatnonzero(self.depth.values.reshape(-1) > -self.depth.spacing)
        total = np.cumsum(self.wanted.reshape(-1)[inside] ** -3)
        node = inside[np.searchsorted(total, random.random(count) * total[-1], side="right")]
        index = np.stack(np.unravel_index(node, self.depth.values.shape), axis=1)
        within = index + random.random((count, 3)) - 0.5
        return np.asarray(self.depth.origin + self.depth.spacing * within)


def depths(surface: PolygonMesh, guard: Guard, threads: int) -> Grid:
    """Distances to ``surface`` on a grid around it, negative where the nearest
    generator is outside."""
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
