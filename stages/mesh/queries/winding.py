"""The generalised winding number of a surface that has holes or wrongly oriented faces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry import triangle_normals
from ..polygons import Floats, Ints
from .parity import RayParity

ASIDE = 1e-4
"""Distance from a triangle at which its two sides are tested, in diagonals of the bounding box."""
ASKED = 200
"""Largest number of triangles of a patch that are tested."""
APART = 0.6
"""The level set counts as the closure of a hole where its distance from the triangles, in edges of
the grid, is more than this."""


@dataclass(frozen=True)
class WindingNumber:
    """The winding number of ``triangles (T, 3)``, all turned outward as far as that can be decided.

    Sources: Jacobson et al. 2013; the fast sum is that of Barill et al. 2018.
    """

    vertices: Floats
    triangles: Ints
    doubled: int
    """Number of duplicate triangles that were removed."""
    turned: int
    """Number of triangles that were turned over."""

    def __call__(self, points: Floats) -> Floats:
        """The winding number ``(N,)`` around ``points (N, 3)``.

        It is 1 deep inside, 0 far outside, and between these near a hole.
        """
        import igl

        return np.asarray(
            igl.fast_winding_number(self.vertices, self.triangles, np.ascontiguousarray(points))
        )


def membranes(
    winding: WindingNumber, level: float, edge: float, closest: Callable[[Floats], Floats]
) -> tuple[Floats, Ints]:
    """Vertices and outward triangles of membranes that close the holes.

    They are the parts of the level set of the winding number at ``level`` that are not close to the
    triangles. Their edges have a length of about ``edge``. ``closest`` gives the closest point on
    the triangles to each point.
    """
    import igl

    low, high = winding.vertices.min(axis=0) - 2 * edge, winding.vertices.max(axis=0) + 2 * edge
    shape = np.ceil((high - low) / edge).astype(np.int64) + 1
    # Marching cubes expects a grid whose first index runs fastest.
    index = np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape[::-1])), axis=1)
    grid = low + edge * index[:, ::-1]
    # Marching cubes takes negative values as inside.
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
    """The winding number of a surface whose triangles may be oriented wrongly.

    Neighbours are first turned to agree, which makes patches. Each patch is then turned outward:
    ``rays`` in several directions test on which of its sides the inside is.
    """
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
    # Where rays do not decide, the orientation of most of the patch's triangles is kept.
    kept = np.where((agreed == single).all(axis=1), area, -area)
    outward = np.where(outward == 0, np.bincount(patch, kept, minlength=count), outward)
    placed = np.where((outward < 0)[patch][:, None], agreed[:, ::-1], agreed)
    # A triangle is unchanged if its corners are in the same cyclic order.
    same = np.any([(np.roll(placed, k, axis=1) == single).all(axis=1) for k in range(3)], axis=0)
    return WindingNumber(
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(placed),
        len(triangles) - len(single),
        int((~same).sum()),
    )


def _spread(patch: Ints, area: Floats) -> Ints:
    """The ASKED largest triangles of each patch."""
    order = np.lexsort((-area, patch))
    starts = np.searchsorted(patch[order], np.arange(patch.max() + 1))
    rank = np.arange(len(order)) - starts[patch[order]]
    return np.asarray(order[rank < ASKED])
