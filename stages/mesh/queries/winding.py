"""The generalised winding number of a surface with holes, or with faces turned the wrong way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry import triangle_normals
from ..polygons import Floats, Ints
from .parity import RayParity

ASIDE = 1e-4
"""How far beside a triangle is asked which side is inside, in diagonals of the bounding box."""
ASKED = 200
"""Triangles of a patch that are asked, at the most."""
APART = 0.6
"""Distance from the triangles, in edges of the grid, from which the level is a hole's."""


@dataclass(frozen=True)
class WindingNumber:
    """Of ``triangles (T, 3)``, all turned outward as far as can be told (Jacobson et al. 2013,
    summed as by Barill et al. 2018)."""

    vertices: Floats
    triangles: Ints
    doubled: int
    """Triangles that were there more than once and count once."""
    turned: int
    """Triangles that had to be turned over."""

    def __call__(self, points: Floats) -> Floats:
        """About ``points (N, 3)``: 1 deep inside, 0 far outside, between them near a hole."""
        import igl

        return np.asarray(
            igl.fast_winding_number(self.vertices, self.triangles, np.ascontiguousarray(points))
        )


def membranes(
    winding: WindingNumber, level: float, edge: float, closest: Callable[[Floats], Floats]
) -> tuple[Floats, Ints]:
    """What closes the holes: vertices and outward triangles, of a size of about ``edge``, of the
    surface where the winding number is ``level``, so far as it runs apart from the triangles;
    ``closest`` gives the point of these nearest to each point."""
    import igl

    low, high = winding.vertices.min(axis=0) - 2 * edge, winding.vertices.max(axis=0) + 2 * edge
    shape = np.ceil((high - low) / edge).astype(np.int64) + 1
    # The first index runs fastest.
    index = np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape[::-1])), axis=1)
    grid = low + edge * index[:, ::-1]
    # What is negative is inside to marching cubes.
    vertices, triangles, _ = igl.marching_cubes(
        level - winding(grid), np.ascontiguousarray(grid), *map(int, shape), 0.0
    )
    middle = vertices[triangles].mean(axis=1)
    apart = np.linalg.norm(middle - closest(middle), axis=1) > APART * edge
    triangles = np.asarray(triangles[apart], np.int64)
    normal, _ = triangle_normals(vertices, triangles)
    behind, ahead = (winding(middle[apart] + side * edge * normal) for side in (-0.5, 0.5))
    turned = behind < ahead
    return vertices, np.where(turned[:, None], triangles[:, ::-1], triangles)


def winding_number(vertices: Floats, triangles: Ints, rays: list[RayParity]) -> WindingNumber:
    """Of a surface as found. Neighbours are turned to agree, patch by patch; a patch is turned
    outward by what ``rays`` in several directions say of its two sides."""
    import igl

    whole = (triangles != triangles[:, [1, 2, 0]]).all(axis=1)
    triangles = triangles[whole]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    single = triangles[np.sort(first)]
    agreed, patch = igl.bfs_orient(np.ascontiguousarray(single))
    normal, area = triangle_normals(vertices, agreed)
    middle = vertices[agreed].mean(axis=1)
    asked = _spread(patch, area)
    aside = ASIDE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    behind, ahead = (
        sum(ray.inside(middle[asked] + side * aside * normal[asked]).astype(int) for ray in rays)
        for side in (-1, 1)
    )
    count = int(patch.max()) + 1
    outward = np.bincount(patch[asked], area[asked] * (behind - ahead), minlength=count)
    # Where rays cannot tell, most of a patch's triangles are taken to be as they were meant.
    kept = np.where((agreed == single).all(axis=1), area, -area)
    outward = np.where(outward == 0, np.bincount(patch, kept, minlength=count), outward)
    placed = np.where((outward < 0)[patch][:, None], agreed[:, ::-1], agreed)
    # The same cycle of corners, from whichever corner.
    same = np.any([(np.roll(placed, k, axis=1) == single).all(axis=1) for k in range(3)], axis=0)
    return WindingNumber(
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(placed),
        len(triangles) - len(single),
        int((~same).sum()),
    )


def _spread(patch: Ints, area: Floats) -> Ints:
    """Of every patch the ASKED largest triangles."""
    order = np.lexsort((-area, patch))
    starts = np.searchsorted(patch[order], np.arange(patch.max() + 1))
    rank = np.arange(len(order)) - starts[patch[order]]
    return np.asarray(order[rank < ASKED])
