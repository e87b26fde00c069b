"""VoroMesh (Maruani et al., ICCV 2023), which moves the generators of a Voronoi diagram by
VoroLoss.

All coordinates are in the frame of that method. The centre of the shape's box is the origin, and
its longest side is 1.8, so that the shape fills nine tenths of the cube [-1, 1]^3.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..compiled import compiled
from ..mesh.polygons import Floats, Ints
from ..voronoi.diagram.delaunay import delaunay
from ..voronoi.diagram.vertices import circumcentres

FILLED = 0.9
"""The longest side of the shape, divided by the edge of the cube."""
MILESTONES = (0.2, 0.375, 0.5, 0.625)
"""Shares of the epochs after which the learning rate is halved: 80, 150, 200 and 250 of 400."""
CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(-1, 3)
"""The corners of the cube, which are outside generators that bound all other cells."""
JITTER = 1e-7
"""Standard deviation of shifts that move unchanged generators away from their lattice."""
PARTS = 8
"""Number of parts into which the samples are divided. It is fixed, so that sums do not depend on
the number of threads."""


@dataclass(frozen=True)
class CubeFrame:
    """The map between coordinates: ``input = centre + scale * cube``."""

    centre: Floats
    scale: float

    @classmethod
    def of_box(cls, box: Floats) -> CubeFrame:
        """The frame in which ``box (2, 3)``, in input units, fills nine tenths of the cube."""
        low, high = box
        return cls(0.5 * (low + high), float((high - low).max()) / (2 * FILLED))

    def cube_from_input(self, points: Floats) -> Floats:
        return (points - self.centre) / self.scale

    def input_from_cube(self, points: Floats) -> Floats:
        return self.centre + self.scale * points


def first_generators(samples: Floats, grid: int) -> Floats:
    """The first generators ``(N, 3)``: nodes of a grid with ``grid``^3 nodes over the cube.

    They are the eight corners of each box between nodes that contains one of ``samples (S, 3)``.
    """
    size = (grid - 1,) * 3
    boxes = np.stack(np.unravel_index(np.unique(box_of(samples, grid)), size), axis=1)
    corners = boxes[:, None] + np.array(list(np.ndindex(2, 2, 2)))
    kept = np.unique(np.ravel_multi_index(tuple(corners.reshape(-1, 3).T), (grid,) * 3))
    nodes: Floats = 2.0 * np.stack(np.unravel_index(kept, (grid,) * 3), axis=1) / (grid - 1) - 1.0
    return nodes


def box_of(points: Floats, grid: int) -> Ints:
    """The number of the grid box ``(N,)`` that contains each of
    ``points (N, 3)``, or is nearest to it."""
    index = np.floor(0.5 * (points + 1.0) * (grid - 1)).astype(np.int64)
    index = np.clip(index, 0, grid - 2)
    return np.asarray(np.ravel_multi_index(tuple(index.T), (grid - 1,) * 3))


@compiled
def _loss_and_gradient(samples: Any, places: Any, starts: Any, size: int, gradient: Any) -> float:
    """The sum over ``samples`` of the squared distance to the boundary of their cell. Adds its
    gradient.

    ``places (N, 3)`` are the generators in the order of their boxes, ``starts (size^3 + 1)`` the
    first generator of each box. Let i be the generator nearest to the sample x, and d_j the
    distances from x. The bisector of i and j has the distance s_j = (d_j^2 - d_i^2) / (2 |g_j -
    g_i|), and the boundary is at the least s_j. Since |g_j - g_i| <= d_i + d_j, s_j >= (d_j - d_i)
    / 2. So generators further away than d_i + 2 s cannot give less than s, and the search ends.
    """
    edge = 2.0 / size
    found = np.empty(len(places), np.int64)
    squares = np.empty(len(places))
    total = 0.0
    for sample in range(len(samples)):
        px, py, pz = samples[sample, 0], samples[sample, 1], samples[sample, 2]
        cx = min(max(int((px + 1.0) / edge), 0), size - 1)
        cy = min(max(int((py + 1.0) / edge), 0), size - 1)
        cz = min(max(int((pz + 1.0) / edge), 0), size - 1)
        # The distances of the point from the sides of its box.
        rx, ry, rz = px + 1.0 - edge * cx, py + 1.0 - edge * cy, pz + 1.0 - edge * cz
        margin = min(min(min(rx, edge - rx), min(ry, edge - ry)), min(rz, edge - rz))
        i = j = -1
        best = np.inf
        for ring in range(1, size + 1):
            count, i, nearest = 0, -1, np.inf
            bottom, top = max(cz - ring, 0), min(cz + ring, size - 1)
            for x in range(max(cx - ring, 0), min(cx + ring, size - 1) + 1):
                for y in range(max(cy - ring, 0), min(cy + ring, size - 1) + 1):
                    row = (x * size + y) * size
                    # Boxes along z follow each other.
                    for k in range(starts[row + bottom], starts[row + top + 1]):
                        dx, dy, dz = places[k, 0] - px, places[k, 1] - py, places[k, 2] - pz
                        square = dx * dx + dy * dy + dz * dz
                        found[count], squares[count] = k, square
                        count += 1
                        if square < nearest:
                            nearest, i = square, k
            reach, limit = np.sqrt(nearest), np.inf
            best, j = np.inf, -1
            for k in range(count):
                if squares[k] >= limit or found[k] == i:
                    continue
                dx = places[found[k], 0] - places[i, 0]
                dy = places[found[k], 1] - places[i, 1]
                dz = places[found[k], 2] - places[i, 2]
                length = dx * dx + dy * dy + dz * dz
                if length > 0.0:
                    distance = 0.5 * (squares[k] - nearest) / np.sqrt(length)
                    if distance < best:
                        best, j = distance, found[k]
                        limit = (reach + 2.0 * best) ** 2
            if j >= 0 and margin + ring * edge >= reach + 2.0 * best:
                break
        if j < 0:  # the cell of a single generator has no boundary
            continue
        total += best * best
        length = 0.0
        for axis in range(3):
            length += (places[j, axis] - places[i, axis]) ** 2
        length = np.sqrt(length)
        for axis in range(3):
            # ds/dg_j = ((g_j - x) - s u) / |g_j - g_i| with the unit vector u along g_j - g_i; the
            # same with changed signs for g_i.
            along = best * (places[j, axis] - places[i, axis]) / length
            factor = 2.0 * best / length
            gradient[j, axis] += factor * (places[j, axis] - samples[sample, axis] - along)
            gradient[i, axis] -= factor * (places[i, axis] - samples[sample, axis] - along)
    return total


def voro_loss(
    generators: Floats, samples: Floats, grid: int, pool: ThreadPoolExecutor
) -> tuple[float, Floats]:
    """The VoroLoss (equation 3 of VoroMesh's paper) and its gradient ``(N, 3)``.

    It is the mean over ``samples (S, 3)`` of the squared distance to the boundary of the Voronoi
    cell that contains the sample. No diagram is computed: that distance is the least one to a
    bisector of the nearest generator and another one. Neighbours are found in a grid of
    ``grid - 1``^3 boxes over the cube [-1, 1]^3.
    """
    size = grid - 1
    box = box_of(generators, grid)
    order = np.argsort(box, kind="stable")
    starts = np.searchsorted(box[order], np.arange(size**3 + 1))
    places = np.ascontiguousarray(generators[order])
    sums = np.zeros((PARTS, *places.shape))

    def part(number: int) -> float:
        share = samples[len(samples) * number // PARTS : len(samples) * (number + 1) // PARTS]
        return _loss_and_gradient(share, places, starts, size, sums[number])

    total = sum(pool.map(part, range(PARTS)))
    gradient = np.empty_like(places)
    gradient[order] = sums.sum(axis=0)
    return total / len(samples), gradient / len(samples)


class _VoroLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, generators: torch.Tensor, loss: Callable[[Floats], tuple[float, Floats]]
    ) -> torch.Tensor:
        value, gradient = loss(generators.detach().cpu().numpy())
        ctx.save_for_backward(torch.as_tensor(gradient, device=generators.device))
        return generators.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor) -> tuple[torch.Tensor, None]:
        return upstream[0] * ctx.saved_tensors[0], None


def differentiable(
    generators: torch.Tensor, samples: Floats, grid: int, pool: ThreadPoolExecutor
) -> torch.Tensor:
    """``voro_loss`` as a function of torch tensors with a gradient."""
    apply: Any = _VoroLoss.apply
    result: torch.Tensor = apply(generators, lambda places: voro_loss(places, samples, grid, pool))
    return result


def bounded(generators: Floats, random: np.random.Generator) -> Floats:
    """``generators (N, 3)``, moved to general position, followed by the corners of the cube."""
    return np.concatenate([generators + JITTER * random.standard_normal(generators.shape), CORNERS])


def cell_centres(generators: Floats) -> Floats:
    """The mean ``(N, 3)`` of the finite Voronoi vertices of each cell, at which its label is
    determined.

    A generator itself may be on the other side of the surface than most of a long cell.
    """
    diagram = delaunay(generators)
    vertices, _ = circumcentres(generators, diagram.corners)
    owner = diagram.corners.ravel()
    count = np.bincount(owner, minlength=len(generators))
    sums = [
        np.bincount(owner, np.repeat(vertices[:, axis], 4), minlength=len(generators))
        for axis in range(3)
    ]
    return np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]


def labels(generators: Floats, inside: Callable[[Floats], NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Whether each cell of ``generators (N, 3)`` is inside; the last ones, the
    cube's corners, are not."""
    found = inside(cell_centres(generators)).copy()
    found[-len(CORNERS) :] = False
    return found
