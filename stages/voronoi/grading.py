"""How large cells are to be, as a function of the distance to the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .delaunay import Floats

NODES = 2_000_000
"""Of the grid that sizes are kept on, about."""


@dataclass(frozen=True)
class Grid:
    """Values at the nodes of a grid, linear between them: what a centroidal tessellation weighs
    space with to get cells of a wanted size."""

    values: Floats
    origin: Floats
    spacing: float

    @property
    def nodes(self) -> tuple[Floats, Floats, float]:
        return self.values, self.origin, self.spacing


@dataclass(frozen=True)
class Sizes:
    """Wanted cell sizes (cube roots of volumes) around a surface.

    At depth d below the surface they are ``min(least + growth d, most)``.
    """

    least: float
    growth: float
    most: float
    depth: Floats
    """Distance to the surface at the nodes of a grid ``(X, Y, Z)``, negative outside."""
    origin: Floats
    spacing: float

    def at_nodes(self) -> Floats:
        return np.minimum(self.least + self.growth * np.abs(self.depth), self.most)

    def density(self) -> Grid:
        """Cells of a centroidal tessellation in space have sizes in proportion to the fifth root
        of the inverse of the density (Gersho; Du, Faber and Gunzburger 1999)."""
        wanted = self.at_nodes() / self.least
        return Grid(np.ascontiguousarray(wanted**-5), self.origin, self.spacing)

    def share(self) -> Grid:
        """Points per volume, 1 at the most."""
        wanted = self.at_nodes() / self.least
        return Grid(np.ascontiguousarray(wanted**-3), self.origin, self.spacing)

    def count(self, layer: float) -> int:
        """Cells of that size deeper than ``layer``, where surface cells end."""
        deep = self.depth > layer
        return round(float((self.at_nodes()[deep] ** -3).sum() * self.spacing**3))
