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

    ``ends (E, 2)`` are vertices: the first of the two ``triangles (E, 2)`` of an edge has it from
    ends[0] to ends[1], the second from ends[1] to ends[0]. ``opposite (E, 2)`` are the third
    corners of these triangles.
    """

    ends: Ints
    triangles: Ints
    opposite: Ints

    @classmethod
    def of(cls, triangles: Ints) -> EdgeTable:
        """The table of ``triangles (T, 3)``.

        Raises ValueError unless each edge is in two triangles, once in each direction.
        """
        count = len(triangles)
        start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
        third = triangles[:, [2, 0, 1]].reshape(-1)
        span = int(triangles.max()) + 1 if count else 1
        key = np.minimum(start, end) * span + np.maximum(start, end)
        # Of the two half-edges of an edge, the one from the smaller index comes first.
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
        """The table of the edges ``chosen (E,)``."""
        return EdgeTable(self.ends[chosen], self.triangles[chosen], self.opposite[chosen])

    def lengths(self, vertices: Floats) -> Floats:
        """Lengths ``(E,)`` of the edges of ``vertices (V, 3)``."""
        return np.asarray(
            np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        )

    def mean_of_neighbours(self, values: Floats) -> Floats:
        """The mean of ``values (V,)`` or ``(V, k)`` over the neighbours of each vertex."""
        start, end = np.concatenate([self.ends, self.ends[:, ::-1]]).T
        count = np.maximum(np.bincount(start, minlength=len(values)), 1)
        flat = values.reshape(len(values), -1)
        sums = [np.bincount(start, column[end], minlength=len(values)) for column in flat.T]
        return np.asarray((np.stack(sums, axis=1) / count[:, None]).reshape(values.shape))


@dataclass
class Sized:
    """Triangles with a target edge length at every vertex, ``length (V,)``.

    The operations of remeshing replace these arrays.
    """

    vertices: Floats
    triangles: Ints
    length: Floats
    carried: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Further values ``(V, k)`` of the vertices, which the operations
    interpolate for new vertices."""

    rank: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """The rank ``(V,)`` of each vertex: 0 if it is free, 1 on a crease, 2 at a corner."""
    creases: Ints = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """The edges on creases ``(K, 3)``: their two ends, and the number of their chain."""
    metric: Callable[[Floats], Floats] | None = None
    """A function that gives the metric ``(N, 3, 3)`` at points ``(N, 3)``. The length
    of an edge that is compared with the target length is measured in this metric; None
    is the Euclidean one."""

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
        """The chain ``(V,)`` of each vertex on a crease, -1 for others. A corner
        has one of its chains."""
        number = np.full(len(self.vertices), -1)
        number[self.creases[:, :2]] = self.creases[:, 2:]
        return number

    def edge_target(self, ends: Ints) -> Floats:
        """The target lengths ``(E,)`` of edges ``ends (E, 2)``, as Euclidean lengths."""
        target = np.asarray(self.length[ends].mean(axis=1))
        if self.metric is None:
            return target
        start, end = self.vertices[ends[:, 0]], self.vertices[ends[:, 1]]
        way = end - start
        square = np.einsum("ij,ij->i", way, way)
        measured = np.einsum("ei,eij,ej->e", way, self.metric(0.5 * (start + end)), way)
        stretch = np.sqrt(square / np.maximum(measured, np.finfo(float).tiny))
        return np.where(square > 0, target * stretch, target)
