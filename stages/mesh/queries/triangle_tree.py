"""A tree of bounding boxes that finds closest points of triangles, and the
first triangle on rays."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ...compiled import compiled
from ..polygons import Floats, Ints

LEAF = 4
"""Largest number of triangles in a leaf."""
DEPTH = 64
"""Size of the stack of nodes. The tree is balanced, so that it is never deeper."""
GRAZED = 1e-9
"""A ray still meets a triangle if it passes beside it by this share of its size. So no ray passes
between two triangles."""
NEEDLE = 1e-14
"""A triangle whose sides form an angle with a smaller squared sine is
treated as its three sides."""
CHUNK = 4096
"""Number of points that a thread processes at a time. The results do not depend on it."""


class BoxTree:
    """A balanced tree over boxes from ``low (T, 3)`` to ``high (T, 3)``.

    A node is divided at the median of the boxes' centres along its longest side (Wald, Boulos and
    Shirley, "Ray tracing deformable scenes using dynamic bounding volume hierarchies", 2007).
    """

    def __init__(self, low: Floats, high: Floats) -> None:
        """Builds the tree."""
        self.leaves = 1
        while LEAF * self.leaves < len(low):
            self.leaves *= 2
        self.order: Ints = np.arange(len(low))
        """The indices of the boxes, leaf by leaf, ``(T,)``."""
        _arrange(self.order, low + high, self.leaves)
        self.boxes = np.empty((2 * self.leaves, 2, 3))
        """The box of each node. The root is 1, and the children of k are 2 k and 2 k + 1."""
        _enclose(self.boxes, low[self.order], high[self.order], self.leaves)


class TriangleTree(BoxTree):
    """A tree over the boxes of ``triangles (T, 3)`` of ``vertices (V, 3)``."""

    def __init__(self, vertices: Floats, triangles: Ints, threads: int = 1) -> None:
        corners = np.ascontiguousarray(vertices, np.float64)[np.asarray(triangles, np.int64)]
        super().__init__(corners.min(axis=1), corners.max(axis=1))
        self.threads = threads
        self.corners = np.ascontiguousarray(corners[self.order])

    def closest(self, points: Floats) -> tuple[Floats, Ints, Floats]:
        """Squared distances ``(N,)`` of ``points (N, 3)`` to the surface, the closest triangles
        ``(N,)``, and the closest points ``(N, 3)``."""
        points = np.ascontiguousarray(points, np.float64)
        square, number = np.empty(len(points)), np.empty(len(points), np.int64)
        place = np.empty((len(points), 3))
        self._in_parts(_search, points, square, number, place)
        return square, self.order[number], place

    def first_met(self, points: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """Distances ``(N,)`` along rays to the first triangle, and these triangles ``(N,)``.

        Rays start at ``points (N, 3)`` and have unit ``directions (N, 3)``. Without a triangle the
        distance is infinite and the index is -1.
        """
        points = np.ascontiguousarray(points, np.float64)
        directions = np.ascontiguousarray(directions, np.float64)
        distance, number = np.empty(len(points)), np.empty(len(points), np.int64)
        self._in_parts(_shoot, points, directions, distance, number)
        return distance, np.where(number < 0, -1, self.order[number])

    def _in_parts(self, kernel: Callable[..., None], *rows: Any) -> None:
        """Call ``kernel`` on CHUNK rows of all arrays at a time, on all threads."""

        def part(start: int) -> None:
            own = (array[start : start + CHUNK] for array in rows)
            kernel(self.corners, self.boxes, self.leaves, *own)

        starts = range(0, len(rows[0]), CHUNK)
        if self.threads == 1 or len(starts) < 2:
            for start in starts:
                part(start)
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(part, starts))


@compiled
def _arrange(order: Ints, middle: Floats, leaves: int) -> None:
    """Sort ``order (T,)`` so that the triangles under each node follow each other.

    ``middle (T, 3)`` is twice the centre of each box.
    """
    count = len(order)
    for node in range(1, leaves):
        depth = 0
        while node >> (depth + 1):
            depth += 1
        width = leaves >> depth
        place = (node - (1 << depth)) * width
        start, end = place * count // leaves, (place + width) * count // leaves
        split = (place + width // 2) * count // leaves
        if end - start < 2:
            continue
        axis, longest = 0, -1.0
        for k in range(3):
            low = high = middle[order[start], k]
            for i in range(start + 1, end):
                low, high = min(low, middle[order[i], k]), max(high, middle[order[i], k])
            if high - low > longest:
                axis, longest = k, high - low
        _select(order, middle[:, axis], start, end, split)


@compiled
def _select(order: Ints, key: Floats, start: int, end: int, split: int) -> None:
    """Hoare's selection in ``order[start:end]``: entries before ``split`` get keys that are not
    larger than the keys of the entries after it."""
    low, high = start, end - 1
    while low < high:
        pivot = key[order[(low + high) // 2]]
        i, j = low, high
        while i <= j:
            while key[order[i]] < pivot:
                i += 1
            while key[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if split <= j:
            high = j
        elif split >= i:
            low = i
        else:
            return


@compiled
def _enclose(boxes: Floats, low: Floats, high: Floats, leaves: int) -> None:
    """Compute the box of each node from the boxes of the triangles in order."""
    count = len(low)
    for leaf in range(leaves):
        boxes[leaves + leaf, 0] = np.inf
        boxes[leaves + leaf, 1] = -np.inf
        for i in range(leaf * count // leaves, (leaf + 1) * count // leaves):
            for k in range(3):
                boxes[leaves + leaf, 0, k] = min(boxes[leaves + leaf, 0, k], low[i, k])
                boxes[leaves + leaf, 1, k] = max(boxes[leaves + leaf, 1, k], high[i, k])
    for node in range(leaves - 1, 0, -1):
        for k in range(3):
            boxes[node, 0, k] = min(boxes[2 * node, 0, k], boxes[2 * node + 1, 0, k])
            boxes[node, 1, k] = max(boxes[2 * node, 1, k], boxes[2 * node + 1, 1, k])


@compiled
def _to_box(box: Floats, x: float, y: float, z: float) -> float:
    """The squared distance of a point to a box."""
    dx = max(box[0, 0] - x, 0.0, x - box[1, 0])
    dy = max(box[0, 1] - y, 0.0, y - box[1, 1])
    dz = max(box[0, 2] - z, 0.0, z - box[1, 2])
    return float(dx * dx + dy * dy + dz * dz)


@compiled
def _search(
    corners: Floats, boxes: Floats, leaves: int, points: Floats,
    square: Floats, number: Ints, place: Floats,
) -> None:  # fmt: skip
    """Write squared distance, triangle and closest point of each of ``points`` to
    the last three arrays."""
    count = len(corners)
    waiting, far = np.empty(DEPTH, np.int64), np.empty(DEPTH)
    found = np.empty(3)
    for row in range(len(points)):
        x, y, z = points[row]
        best, nearest = np.inf, 0
        waiting[0], far[0], left = 1, _to_box(boxes[1], x, y, z), 1
        while left:
            left -= 1
            node = waiting[left]
            if far[left] >= best:
                continue
            while node < leaves:
                first = _to_box(boxes[2 * node], x, y, z)
                second = _to_box(boxes[2 * node + 1], x, y, z)
                node *= 2
                if second < first:
                    first, second = second, first
                    node += 1
                if second < best:
                    waiting[left], far[left] = node ^ 1, second
                    left += 1
                if first >= best:
                    node = -1
                    break
            if node < 0:
                continue
            leaf = node - leaves
            for i in range(leaf * count // leaves, (leaf + 1) * count // leaves):
                distance = _to_triangle(corners[i], x, y, z, found)
                if distance < best:
                    best, nearest = distance, i
                    place[row, 0], place[row, 1], place[row, 2] = found[0], found[1], found[2]
        square[row], number[row] = best, nearest


@compiled
def _to_triangle(corners: Any, x: float, y: float, z: float, found: Floats) -> float:
    """The squared distance of a point to a triangle. The closest point is written to
    ``found (3,)``.

    Source: Ericson, "Real-time collision detection", 2005, section 5.1.5. The region of the
    triangle's plane over which the point lies decides which corner, side or inner point is closest.
    """
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    up, vp = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    uu, uv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    # s and t divided by area are coordinates along two sides, if the point is over the inside.
    s, t, area = vv * up - uv * vp, uu * vp - uv * up, uu * vv - uv * uv
    if s >= 0 and t >= 0 and s + t <= area and area > NEEDLE * uu * vv:
        s, t = s / area, t / area
    else:
        # Otherwise the closest point is on one of the three sides.
        s = min(max(up / uu, 0.0), 1.0) if uu > 0 else 0.0
        t = 0.0
        least = _off(px, py, pz, s * ux, s * uy, s * uz)
        along = min(max(vp / vv, 0.0), 1.0) if vv > 0 else 0.0
        off = _off(px, py, pz, along * vx, along * vy, along * vz)
        if off < least:
            least, s, t = off, 0.0, along
        ww = uu - 2 * uv + vv
        along = min(max((uu - uv - up + vp) / ww, 0.0), 1.0) if ww > 0 else 0.0
        s_, t_ = 1 - along, along
        off = _off(px, py, pz, s_ * ux + t_ * vx, s_ * uy + t_ * vy, s_ * uz + t_ * vz)
        if off < least:
            s, t = s_, t_
    qx, qy, qz = s * ux + t * vx, s * uy + t * vy, s * uz + t * vz
    found[0], found[1], found[2] = ax + qx, ay + qy, az + qz
    return _off(px, py, pz, qx, qy, qz)


@compiled
def _off(px: float, py: float, pz: float, qx: float, qy: float, qz: float) -> float:
    return (px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2


@compiled
def _entry(box: Floats, point: Floats, inverse: Floats, furthest: float) -> float:
    """Distance along a ray at which it enters a box; infinity if that is ``furthest`` or more."""
    begin, end = 0.0, furthest
    for k in range(3):
        if np.isinf(inverse[k]):
            if point[k] < box[0, k] or point[k] > box[1, k]:
                return np.inf
            continue
        one = (box[0, k] - point[k]) * inverse[k]
        other = (box[1, k] - point[k]) * inverse[k]
        begin, end = max(begin, min(one, other)), min(end, max(one, other))
    return begin if begin <= end else np.inf


@compiled
def _shoot(
    corners: Floats, boxes: Floats, leaves: int, points: Floats, directions: Floats,
    distance: Floats, number: Ints,
) -> None:  # fmt: skip
    """Write the distance and the index of the first triangle on each ray to the last two arrays."""
    count = len(corners)
    waiting, far = np.empty(DEPTH, np.int64), np.empty(DEPTH)
    inverse = np.empty(3)
    for row in range(len(points)):
        point, way = points[row], directions[row]
        for k in range(3):
            inverse[k] = 1 / way[k] if way[k] != 0 else np.inf
        best, nearest = np.inf, -1
        waiting[0], far[0], left = 1, _entry(boxes[1], point, inverse, best), 1
        while left:
            left -= 1
            node = waiting[left]
            if far[left] >= best:
                continue
            while node < leaves:
                first = _entry(boxes[2 * node], point, inverse, best)
                second = _entry(boxes[2 * node + 1], point, inverse, best)
                node *= 2
                # The same lines are in _search: a function for both takes 1.3 times as long.
                if second < first:
                    first, second = second, first
                    node += 1
                if second < best:
                    waiting[left], far[left] = node ^ 1, second
                    left += 1
                if first >= best:
                    node = -1
                    break
            if node < 0:
                continue
            leaf = node - leaves
            for i in range(leaf * count // leaves, (leaf + 1) * count // leaves):
                reach = _to_plane(corners[i], point, way)
                if reach < best:
                    best, nearest = reach, i
        distance[row], number[row] = best, nearest


@compiled
def _to_plane(corners: Floats, point: Floats, way: Floats) -> float:
    """Distance along a ray to a triangle, infinity if it does not meet it.

    Source: Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = way[1] * vz - way[2] * vy, way[2] * vx - way[0] * vz, way[0] * vy - way[1] * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0:
        return np.inf
    sx, sy, sz = point[0] - ax, point[1] - ay, point[2] - az
    u = (sx * px + sy * py + sz * pz) / determinant
    if u < -GRAZED or u > 1 + GRAZED:
        return np.inf
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (way[0] * qx + way[1] * qy + way[2] * qz) / determinant
    if v < -GRAZED or u + v > 1 + GRAZED:
        return np.inf
    reach = (vx * qx + vy * qy + vz * qz) / determinant
    return reach if reach > 0 else np.inf
