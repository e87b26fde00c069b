"""A regular grid of nodes around a shape, and the surface between those inside and the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints


@dataclass(frozen=True)
class NodeGrid:
    """``nodes (N, 3)``, the first index running fastest, and ``shape``; those at the border are
    outside the shape."""

    nodes: Floats
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, points: Floats, edge: float) -> NodeGrid:
        """With a layer of nodes beyond the box of ``points``, ``edge`` apart."""
        low, high = points.min(axis=0), points.max(axis=0)
        shape = np.ceil((high - low) / edge).astype(int) + 3
        index = np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape[::-1])), axis=1)
        nodes = np.ascontiguousarray(low + edge * (index[:, ::-1] - 1.0))
        return cls(nodes, (int(shape[0]), int(shape[1]), int(shape[2])))

    @property
    def border(self) -> NDArray[np.bool_]:
        """The outermost nodes ``(N,)``."""
        inner = np.zeros(self.shape[::-1], dtype=bool)
        inner[1:-1, 1:-1, 1:-1] = True
        return ~inner.reshape(-1)

    def beside(self, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Nodes with a neighbour, diagonal ones too, on the other side of ``inside (N,)``."""
        from scipy.ndimage import maximum_filter, minimum_filter

        solid = inside.reshape(self.shape[::-1]).astype(np.uint8)
        mixed = maximum_filter(solid, 3) != minimum_filter(solid, 3)
        return np.asarray(mixed.reshape(-1))

    def surface(self, values: Floats, speck: float) -> tuple[Floats, Ints]:
        """Vertices and outward triangles where ``values (N,)``, positive inside, are zero; pieces
        smaller than ``speck`` of the largest left out."""
        import igl

        # A node that is on the surface would be the corner of triangles without area.
        values = np.where(self.border, -np.abs(values), values)
        vertices, triangles, _ = igl.marching_cubes(-values, self.nodes, *self.shape, 0.0)
        return without_specks(np.asarray(vertices), np.asarray(triangles, np.int64), speck)


def without_specks(vertices: Floats, triangles: Ints, speck: float) -> tuple[Floats, Ints]:
    """A closed surface without the pieces whose volume is less than ``speck`` of the largest's."""
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    count, part = components(len(vertices), np.stack([start, end], axis=1))
    part = part[triangles[:, 0]]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    volume = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    triangles = triangles[(np.abs(volume) > speck * np.abs(volume).max())[part]]
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    return vertices[used], (np.cumsum(used) - 1)[triangles]
