"""Division of triangles until no edge is longer than a limit. The surface does not change."""

from __future__ import annotations

import numpy as np

from .polygons import Floats, Ints

ROUNDS = 24
"""Largest number of times that an edge is halved."""


def subdivided(
    vertices: Floats, triangles: Ints, longest: float, most: int
) -> tuple[Floats, Ints] | None:
    """``vertices (V, 3)`` and ``triangles (T, 3)`` with no edge longer than ``longest``.

    Longer edges are halved, in both of their triangles, until none is left. Returns None if that
    takes more than ``most`` vertices.
    """
    for _ in range(ROUNDS):
        ends = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2)
        key = ends.min(axis=2) * len(vertices) + ends.max(axis=2)
        edges, corner = np.unique(key, return_inverse=True)
        start, end = np.divmod(edges, len(vertices))
        long = np.linalg.norm(vertices[start] - vertices[end], axis=1) > longest
        if not long.any():
            return vertices, triangles
        if len(vertices) + long.sum() > most:
            return None
        middle = np.full(len(edges), -1)
        middle[long] = len(vertices) + np.arange(long.sum())
        vertices = np.concatenate([vertices, 0.5 * (vertices[start[long]] + vertices[end[long]])])
        triangles = _divided(triangles, middle[corner.reshape(-1, 3)])
    return vertices, triangles


def _divided(triangles: Ints, middle: Ints) -> Ints:
    """The triangles, divided at ``middle (T, 3)``: the new vertex on the edge
    after each corner, or -1."""
    count = (middle >= 0).sum(axis=1)
    # Corners are rotated: a single middle comes first; of two, the edge without one comes last.
    turn = np.where(count == 1, (middle >= 0).argmax(axis=1), (middle < 0).argmax(axis=1) + 1)
    order = (np.where(np.isin(count, (1, 2)), turn, 0)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, order, axis=1).T
    p, q, r = np.take_along_axis(middle, order, axis=1).T
    patterns = {
        0: [(a, b, c)],
        1: [(a, p, c), (p, b, c)],
        2: [(a, p, q), (p, b, q), (a, q, c)],
        3: [(a, p, r), (p, b, q), (r, q, c), (p, q, r)],
    }
    return np.concatenate(
        [
            np.stack(corners, axis=1)[count == number]
            for number, parts in patterns.items()
            for corners in parts
        ]
    )
