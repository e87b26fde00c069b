"""Inside or outside by counting crossings of rays, for many points at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..polygons import Floats, Ints

PAIRS_AT_ONCE = 2_000_000
"""Number of pairs of a point and a triangle that are tested at once, which bounds the memory."""
MOST_ENTRIES = 20_000_000
"""Largest number of entries in the bins, which bounds the memory."""


def _rotation() -> Floats:
    """A fixed rotation without special angles, so that no edge of a designed shape
    is parallel to a ray."""
    quaternion = np.array([0.7310585786, 0.2401873452, -0.5179328641, 0.3732457815])
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class RayParity:
    """Counts how often a ray from each point meets a triangle surface. Inside, the count is odd.

    All rays have the same direction, and triangles are sorted into bins on the plane across it. Two
    triangles with a common edge use the same arithmetic for it, so that no ray passes between the
    triangles of a closed surface.
    """

    def __init__(self, vertices: Floats, triangles: Ints, direction: int = 0) -> None:
        """``direction`` is 0, 1 or 2 and selects one of three perpendicular directions of rays."""
        self.frame = np.roll(_rotation(), direction, axis=0)
        placed = vertices @ self.frame.T
        # A triangle with two equal corners meets no ray.
        whole = (triangles != triangles[:, [1, 2, 0]]).all(axis=1)
        order = np.argsort(triangles[whole], axis=1)
        ordered = np.take_along_axis(triangles[whole], order, axis=1)
        self.turned = (order[:, 1] - order[:, 0]) % 3 == 2
        self.corners = placed[ordered]
        low, high = self.corners[..., :2].min(axis=1), self.corners[..., :2].max(axis=1)
        self.origin = low.min(axis=0) if len(low) else np.zeros(2)
        top = high.max(axis=0) if len(high) else np.ones(2)
        self.bins = 2 * int(np.clip(np.sqrt(len(ordered)), 1, 1024))
        span = np.maximum(top - self.origin, np.finfo(float).tiny)
        count = np.array([MOST_ENTRIES + 1])
        while count.sum() > MOST_ENTRIES and self.bins > 1:  # long triangles are in many bins
            self.bins //= 2
            self.scale = self.bins / span
            first, last = self._bin(low), self._bin(high)
            size = last - first + 1
            count = size.prod(axis=1)
        owner = np.repeat(np.arange(len(ordered)), count)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        width = size[owner, 1]
        cell = (first[owner, 0] + within // width) * self.bins + first[owner, 1] + within % width
        order = np.argsort(cell, kind="stable")
        self.members = owner[order]
        self.starts = np.searchsorted(cell[order], np.arange(self.bins**2 + 1))

    def _bin(self, points: Floats) -> Ints:
        place = np.floor((points - self.origin) * self.scale)
        return np.clip(place, 0, self.bins - 1).astype(np.int64)

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether the ray from each of ``points (N, 3)`` meets the surface an odd
        number of times, ``(N,)``."""
        return np.asarray(self._crossings(points)[0] % 2 == 1)

    def winding(self, points: Floats) -> Ints:
        """The winding number ``(N,)`` of a closed, oriented surface around ``points (N, 3)``.

        It is 1 inside a surface with outward normals, and 2 where two such bodies overlap.
        """
        return self._crossings(points)[1]

    def _crossings(self, points: Floats) -> tuple[Ints, Ints]:
        placed = points @ self.frame.T
        cells = self._bin(placed[:, :2]) @ np.array([self.bins, 1])
        begin, end = self.starts[cells], self.starts[cells + 1]
        number = np.zeros(len(points), dtype=np.int64)
        signed = np.zeros(len(points), dtype=np.int64)
        total = np.cumsum(end - begin)
        at = 0
        while at < len(points):
            done = total[at - 1] if at else 0
            stop = max(at + 1, int(np.searchsorted(total, done + PAIRS_AT_ONCE, side="right")))
            number[at:stop], signed[at:stop] = self._count(
                placed[at:stop], begin[at:stop], end[at:stop]
            )
            at = stop
        return number, signed

    def _count(self, points: Floats, begin: Ints, end: Ints) -> tuple[Ints, Ints]:
        count = end - begin
        owner = np.repeat(np.arange(len(points)), count)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        member = self.members[begin[owner] + within]
        px, py = points[owner, 0], points[owner, 1]
        corner = self.corners[member]
        crossing = np.zeros(len(owner), dtype=bool)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            xi, yi, xj, yj = corner[:, i, 0], corner[:, i, 1], corner[:, j, 0], corner[:, j, 1]
            straddles = (yi > py) != (yj > py)
            left = (px - xi) * (yj - yi) < (py - yi) * (xj - xi)
            crossing ^= straddles & (left == (yj > yi))
        hit = np.flatnonzero(crossing)
        corner, owner = corner[hit], owner[hit]
        edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        normal = np.cross(edge1, edge2)
        reach = np.einsum("ij,ij->i", corner[:, 0] - points[owner], normal)
        above = reach * normal[:, 2] > 0
        # A ray leaves the body where the triangle's normal has a positive part along the ray.
        leaving = np.where((normal[:, 2] > 0) != self.turned[member[hit]], 1, -1)
        number = np.bincount(owner[above], minlength=len(points))
        signed = np.bincount(owner[above], leaving[above], minlength=len(points))
        return number, np.rint(signed).astype(np.int64)
