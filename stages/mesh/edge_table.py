"""The edges of a closed triangle surface with the two triangles of each, as flat arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .polygons import Floats, Ints


@dataclass(frozen=True)
class EdgeTable:
    """The edges of a closed triangle surface.

    ``ends (E, 2)``: the first triangle has the edge from ends[0] to ends[1], the second the other
    way round. ``triangles (E, 2)`` and their third corners ``opposite (E, 2)``.
    """

    ends: Ints
    triangles: Ints
    opposite: Ints

    @classmethod
    def of(cls, triangles: Ints) -> EdgeTable:
        """The table. Raises ValueError unless every edge is in two triangles, once each way."""
        count = len(triangles)
        start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
        third = triangles[:, [2, 0, 1]].reshape(-1)
        span = int(triangles.max()) + 1 if count else 1
        key = np.minimum(start, end) * span + np.maximum(start, end)
        # Within an edge the half-edge that goes up comes first.
        order = np.argsort(2 * key + (start > end)).reshape(-1)
        if len(order) % 2:
            raise ValueError("the surface is not closed")
        first, second = order[0::2], order[1::2]
        paired = (key[first] == key[second]) & (start[first] < end[first])
        paired &= start[second] > end[second]
        if not paired.all() or (key[first][1:] == key[first][:-1]).any():
            raise ValueError("the surface is not closed")
        return cls(
            np.stack([start[first], end[first]], 1),
            np.stack([first // 3, second // 3], 1),
            np.stack([third[first], third[second]], 1),
        )

    def rows(self, chosen: NDArray[np.bool_]) -> EdgeTable:
        """The edges ``chosen (E,)``."""
        return EdgeTable(self.ends[chosen], self.triangles[chosen], self.opposite[chosen])

    def lengths(self, vertices: Floats) -> Floats:
        return np.asarray(
            np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        )

    def mean_of_neighbours(self, values: Floats) -> Floats:
        """Of ``values (V,)`` or ``(V, k)`` at the vertices, the means over their neighbours."""
        start, end = np.concatenate([self.ends, self.ends[:, ::-1]]).T
        count = np.maximum(np.bincount(start, minlength=len(values)), 1)
        flat = values.reshape(len(values), -1)
        sums = [np.bincount(start, column[end], minlength=len(values)) for column in flat.T]
        return np.asarray((np.stack(sums, axis=1) / count[:, None]).reshape(values.shape))


@dataclass
class Sized:
    """Triangles with a target length at every vertex; the operations replace the arrays."""

    vertices: Floats
    triangles: Ints
    length: Floats
    carried: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Further values of the vertices ``(V, k)`` that go with them through the operations."""

    rank: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """0 for a vertex that is free, 1 on a crease, 2 at a corner, ``(V,)``."""
    creases: Ints = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """The edges that lie on creases: their ends and the number of their chain, ``(K, 3)``."""
    metric: Callable[[Floats], Floats] | None = None
    """The metric ``(N, 3, 3)`` at points in which edges are to have their target lengths."""

    def __post_init__(self) -> None:
        if len(self.rank) != len(self.vertices):
            self.rank = np.zeros(len(self.vertices), np.int64)
        if len(self.carried) != len(self.vertices):
            self.carried = np.zeros((len(self.vertices), 0))

    def on_crease(self, ends: Ints) -> NDArray[np.bool_]:
        """Which edges ``(E, 2)`` lie on creases."""
        span = np.array([len(self.vertices), 1])
        return np.isin(np.sort(ends, axis=1) @ span, np.sort(self.creases[:, :2], axis=1) @ span)

    def chains(self) -> Ints:
        """The chain ``(V,)`` that a vertex on a crease belongs to; one of several at a corner, -1
        for others."""
        number = np.full(len(self.vertices), -1)
        number[self.creases[:, :2]] = self.creases[:, 2:]
        return number

    def edge_target(self, ends: Ints) -> Floats:
        """The lengths ``(E,)`` that edges of these directions are to have."""
        target = np.asarray(self.length[ends].mean(axis=1))
        if self.metric is None:
            return target
        start, end = self.vertices[ends[:, 0]], self.vertices[ends[:, 1]]
        way = end - start
        square = np.einsum("ij,ij->i", way, way)
        measured = np.einsum("ei,eij,ej->e", way, self.metric(0.5 * (start + end)), way)
        stretch = np.sqrt(square / np.maximum(measured, np.finfo(float).tiny))
        return np.where(square > 0, target * stretch, target)
