"""Pairs of triangles of one surface that cross each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled import compiled
from ..polygons import Floats, Ints
from .triangle_tree import DEPTH as DEEPEST
from .triangle_tree import BoxTree

DEPTH = 1e-9
"""Triangles cross if they overlap by more than this, in diagonals of the bounding box.

Corners are rounded to 1e-16 of their coordinates, and faces with more than three corners are flat
only to that precision. A depth 1e7 times as large cannot come from rounding.
"""


def self_intersections(
    vertices: Floats, triangles: Ints, asked: NDArray[np.bool_] | None = None
) -> Ints:
    """The pairs ``(P, 2)`` of ``triangles (T, 3)`` that cross or overlap, smaller index first.

    With ``asked (T,)``, only pairs with at least one such triangle are sought. Two triangles cross
    if an edge of one meets the other and has its ends on both sides of it, more than DEPTH away.
    Triangles in one plane overlap if they have area in common; two neighbours that are folded onto
    each other do. Triangles without area are left out.
    """
    wanted = np.ones(len(triangles), dtype=bool) if asked is None else asked
    if len(triangles) < 2 or not wanted.any():
        return np.zeros((0, 2), np.int64)
    low, high = vertices[triangles].min(axis=(0, 1)), vertices[triangles].max(axis=(0, 1))
    diagonal = float(np.linalg.norm(high - low))
    if not diagonal > 0:
        return np.zeros((0, 2), np.int64)
    placed = np.ascontiguousarray((vertices - low) / diagonal)
    boxes = np.stack([placed[triangles].min(axis=1), placed[triangles].max(axis=1)], axis=1)
    tree = BoxTree(boxes[:, 0], boxes[:, 1])
    pairs = _crossings(
        placed, np.ascontiguousarray(triangles), boxes, tree.order, tree.boxes, wanted
    )
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


@compiled
def _crossings(
    vertices: Floats,
    triangles: Ints,
    boxes: Floats,
    order: Ints,
    nodes: Floats,
    asked: NDArray[np.bool_],
) -> Ints:
    """The pairs of triangles that cross, with at least one ``asked`` triangle each.

    Candidates are triangles whose ``boxes (T, 2, 3)`` meet. They are found in the tree of boxes
    ``nodes``, whose leaves have the triangles in ``order``.
    """
    found = np.empty((64, 2), np.int64)
    count, total, leaves = 0, len(order), len(nodes) // 2
    normal, solid = _normals(vertices, triangles)
    waiting = np.empty(DEEPEST, np.int64)
    for a in order:
        if not (asked[a] and solid[a]):
            continue
        waiting[0], left = 1, 1
        while left:
            left -= 1
            node = waiting[left]
            if not _meet(nodes[node], boxes[a]):
                continue
            if node < leaves:
                waiting[left], waiting[left + 1] = 2 * node, 2 * node + 1
                left += 2
                continue
            leaf = node - leaves
            for i in range(leaf * total // leaves, (leaf + 1) * total // leaves):
                b = order[i]
                # If both triangles are asked for, the one with the smaller index finds the pair.
                if b == a or not solid[b] or (asked[b] and b < a):
                    continue
                if not _meet(boxes[a], boxes[b]):
                    continue
                low, high = min(a, b), max(a, b)
                if _cross(vertices, triangles[low], triangles[high], normal[low], normal[high]):
                    if count == len(found):
                        larger = np.empty((2 * count, 2), np.int64)
                        larger[:count] = found
                        found = larger
                    found[count, 0], found[count, 1] = low, high
                    count += 1
    return found[:count]


@compiled
def _meet(one: Floats, other: Floats) -> bool:
    """Whether two boxes ``(2, 3)`` have a point in common."""
    meet = True
    for k in range(3):
        meet = meet and one[0, k] <= other[1, k] and other[0, k] <= one[1, k]
    return meet


@compiled
def _normals(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """Unit normals ``(T, 3)``, and 1 for triangles with a height of more than DEPTH ``(T,)``."""
    normal = np.zeros((len(triangles), 3))
    solid = np.zeros(len(triangles), np.int64)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        size, longest = 0.0, 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            normal[t, i] = (vertices[b, j] - vertices[a, j]) * (vertices[c, k] - vertices[a, k])
            normal[t, i] -= (vertices[b, k] - vertices[a, k]) * (vertices[c, j] - vertices[a, j])
            size += normal[t, i] ** 2
        for u, v in ((a, b), (b, c), (c, a)):
            longest = max(longest, _along(vertices, u, v, u, v))
        size = np.sqrt(size)
        if size > DEPTH * np.sqrt(longest) and size > 0:
            normal[t] /= size
            solid[t] = 1
    return normal, solid


@compiled
def _along(vertices: Floats, a: int, b: int, c: int, d: int) -> float:
    """The scalar product of the vectors from ``a`` to ``b`` and from ``c`` to ``d``."""
    total = 0.0
    for k in range(3):
        total += (vertices[b, k] - vertices[a, k]) * (vertices[d, k] - vertices[c, k])
    return total


@compiled
def _height(vertices: Floats, start: int, end: int, normal: Floats) -> float:
    """The coordinate of ``end`` along ``normal``, measured from ``start``."""
    total = 0.0
    for k in range(3):
        total += (vertices[end, k] - vertices[start, k]) * normal[k]
    return total


@compiled
def _inward(vertices: Floats, start: int, end: int, normal: Floats, x: Floats) -> float:
    """The signed distance of point ``x`` to the left of the line from ``start`` to ``end``.

    Left is as seen against ``normal``. Inside a triangle with that normal it is positive for all
    edges.
    """
    total, length = 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        left = normal[j] * (vertices[end, k] - vertices[start, k])
        left -= normal[k] * (vertices[end, j] - vertices[start, j])
        total += (x[i] - vertices[start, i]) * left
        length += (vertices[end, i] - vertices[start, i]) ** 2
    return float(total / np.sqrt(length))


@compiled
def _depth(vertices: Floats, q: Ints, normal: Floats, x: Floats) -> float:
    """The least signed distance of ``x``, a point in the plane of ``q``, to the edges of triangle
    ``q``. It is positive inside."""
    least = np.inf
    for i in range(3):
        least = min(least, _inward(vertices, q[i], q[(i + 1) % 3], normal, x))
    return least


@compiled
def _cross(vertices: Floats, p: Ints, q: Ints, p_normal: Floats, q_normal: Floats) -> bool:
    """Whether triangles ``p (3,)`` and ``q (3,)`` cross, or overlap in one plane."""
    flat = True
    for i in range(3):
        flat = flat and abs(_height(vertices, q[0], p[i], q_normal)) <= DEPTH
        flat = flat and abs(_height(vertices, p[0], q[i], p_normal)) <= DEPTH
    if flat:
        turn = 1.0 if (p_normal * q_normal).sum() > 0 else -1.0
        return _overlap(vertices, p, q, p_normal, turn * p_normal)
    return _pierces(vertices, p, q, q_normal) or _pierces(vertices, q, p, p_normal)


@compiled
def _pierces(vertices: Floats, p: Ints, q: Ints, normal: Floats) -> bool:
    """Whether an edge of ``p`` passes through ``q``, which has the given ``normal``."""
    x = np.empty(3)
    for i in range(3):
        start, end = p[i], p[(i + 1) % 3]
        here, there = (
            _height(vertices, q[0], start, normal),
            _height(vertices, q[0], end, normal),
        )
        if min(here, there) < -DEPTH and max(here, there) > DEPTH:
            share = here / (here - there)
            for k in range(3):
                x[k] = vertices[start, k] + share * (vertices[end, k] - vertices[start, k])
            # A part and its mirror image have edges that meet exactly in the mirror plane.
            if _depth(vertices, q, normal, x) > -DEPTH:
                return True
    return False


@compiled
def _overlap(vertices: Floats, p: Ints, q: Ints, p_normal: Floats, q_normal: Floats) -> bool:
    """Whether two triangles in one plane have area in common."""
    middle = np.zeros(3)
    for one, other, normal in ((p, q, q_normal), (q, p, p_normal)):
        for k in range(3):
            middle[k] = (vertices[one[0], k] + vertices[one[1], k] + vertices[one[2], k]) / 3
        if _depth(vertices, other, normal, middle) > DEPTH:
            return True
        for i in range(3):
            if _depth(vertices, other, normal, vertices[one[i]]) > DEPTH:
                return True
    for i in range(3):
        for j in range(3):
            a, b, c, d = p[i], p[(i + 1) % 3], q[j], q[(j + 1) % 3]
            if _divided(vertices, a, b, c, d, p_normal) and _divided(
                vertices, c, d, a, b, p_normal
            ):
                return True
    return False


@compiled
def _divided(vertices: Floats, a: int, b: int, c: int, d: int, normal: Floats) -> bool:
    """Whether ``c`` and ``d`` lie on opposite sides of the line from ``a`` to ``b``."""
    one = _inward(vertices, a, b, normal, vertices[c])
    two = _inward(vertices, a, b, normal, vertices[d])
    return min(one, two) < -DEPTH and max(one, two) > DEPTH
