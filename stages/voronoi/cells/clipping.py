"""Single Voronoi cells, each cut out of a box by the bisector planes of its neighbours.

A cell is stored as its vertices, each with the three planes that meet there, in a consistent
orientation. A further plane cuts off a set of vertices. Each edge between these and the others
gives a new vertex. Moments need no faces: the feet of the generator on each face's plane and on
each edge's line, with the generator and the vertex, form signed tetrahedra that add up to the cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compiled import compiled

INCOMPLETE, CROWDED = 1, 2
"""Values of the status: more neighbours are needed; the cell has more planes than fit."""


@compiled
def _at(grid: Any, origin: Any, spacing: float, x: float, y: float, z: float) -> float:
    """The value of ``grid`` at a point, linear between nodes and constant outside of the grid."""
    place = np.empty(3, np.int64)
    share = np.empty(3)
    for axis in range(3):
        value = ((x, y, z)[axis] - origin[axis]) / spacing
        most = grid.shape[axis] - 1
        value = min(max(value, 0.0), float(most))
        place[axis] = min(int(value), max(most - 1, 0))
        share[axis] = value - place[axis]
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (
            (share[0] if i else 1 - share[0])
            * (share[1] if j else 1 - share[1])
            * (share[2] if k else 1 - share[2])
        )
        if weight > 0:
            total += weight * grid[place[0] + i, place[1] + j, place[2] + k]
    return total


@compiled
def cell_sums(
    points: Any,
    cells: Any,
    around: Any,
    low: Any,
    high: Any,
    density: Any,
    origin: Any,
    spacing: float,
    most: int,
    sums: Any,
    status: Any,
) -> None:  # pragma: no cover
    """Compute mass, first moments, energy and volume of ``cells (M,)``, indices of
    ``points (N, 3)``.

    ``around (M, K)`` has the nearest other points of each cell, nearest first. ``density`` has
    values at the nodes of a grid; if it is empty, the density is 1. ``sums (M, 6)`` gets mass,
    three moments about the generator, energy, and volume. ``status (M,)`` becomes INCOMPLETE if a
    cell needs more neighbours, CROWDED if it has more than ``most`` planes, else 0.
    """
    weighted = density.size > 0
    room = 2 * most  # With three faces at each vertex, a cell has fewer vertices than this.
    normal = np.empty((most, 3))
    offset = np.empty(most)
    number = np.empty(most, np.int64)
    ends = np.empty((room, 3), np.int64)
    place = np.empty((room, 3))
    gone = np.empty(room, np.bool_)
    stamp = np.zeros((most, most), np.int32)
    loose = np.empty((room, 2), np.int64)
    foot = np.empty((3, 3))
    clip = 0
    for row in range(len(cells)):
        here = points[cells[row]]
        planes, count = 6, 8
        for axis in range(3):
            for side in range(2):
                k = 2 * axis + side
                normal[k] = 0.0
                normal[k, axis] = 1.0 if side else -1.0
                offset[k] = high[axis] - here[axis] if side else here[axis] - low[axis]
        for corner in range(8):
            i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
            ends[corner, 0], ends[corner, 1], ends[corner, 2] = i, 2 + j, 4 + k
            if (i + j + k) % 2 == 0:  # the order is reversed for an even number of upper sides
                ends[corner, 1], ends[corner, 2] = 4 + k, 2 + j
            place[corner, 0] = offset[1] if i else -offset[0]
            place[corner, 1] = offset[3] if j else -offset[2]
            place[corner, 2] = offset[5] if k else -offset[4]
        reach = 0.0
        for v in range(count):
            reach = max(reach, place[v, 0] ** 2 + place[v, 1] ** 2 + place[v, 2] ** 2)
        status[row] = INCOMPLETE if around.shape[1] < len(points) - 1 else 0
        for other in around[row]:
            nx = points[other, 0] - here[0]
            ny = points[other, 1] - here[1]
            nz = points[other, 2] - here[2]
            square = nx * nx + ny * ny + nz * nz
            if square > 4 * reach:
                status[row] = 0
                break
            half = 0.5 * square
            clip += 1
            cut = 0
            for v in range(count):
                gone[v] = place[v, 0] * nx + place[v, 1] * ny + place[v, 2] * nz > half
                if gone[v]:
                    cut += 1
                    a, b, c = ends[v, 0], ends[v, 1], ends[v, 2]
                    stamp[a, b] = clip
                    stamp[b, c] = clip
                    stamp[c, a] = clip
            if cut == 0:
                continue
            edges = 0
            for v in range(count):
                if gone[v]:
                    for k in range(3):
                        a, b = ends[v, k], ends[v, (k + 1) % 3]
                        if stamp[b, a] != clip:
                            loose[edges, 0], loose[edges, 1] = a, b
                            edges += 1
            kept = 0
            for v in range(count):
                if not gone[v]:
                    ends[kept] = ends[v]
                    place[kept] = place[v]
                    kept += 1
            if planes == most:  # slots of vertices that were cut off are reused
                number[:] = -1
                for v in range(kept):
                    for k in range(3):
                        number[ends[v, k]] = 0
                planes = 0
                for k in range(most):
                    if number[k] == 0:
                        number[k] = planes
                        normal[planes], offset[planes] = normal[k], offset[k]
                        planes += 1
                for v in range(kept):
                    for k in range(3):
                        ends[v, k] = number[ends[v, k]]
                for e in range(edges):
                    for k in range(2):
                        loose[e, k] = number[loose[e, k]]
            if planes == most or kept + edges > room:
                status[row] = CROWDED
                break
            normal[planes, 0], normal[planes, 1], normal[planes, 2] = nx, ny, nz
            offset[planes] = half
            for e in range(edges):
                a, b = loose[e, 0], loose[e, 1]
                ends[kept, 0], ends[kept, 1], ends[kept, 2] = a, b, planes
                u, w = normal[a], normal[b]
                # Cramer's rule for the point on three planes.
                bx = w[1] * nz - w[2] * ny
                by = w[2] * nx - w[0] * nz
                bz = w[0] * ny - w[1] * nx
                whole = u[0] * bx + u[1] * by + u[2] * bz
                if whole == 0.0:
                    whole = 1e-300
                cx = ny * u[2] - nz * u[1]
                cy = nz * u[0] - nx * u[2]
                cz = nx * u[1] - ny * u[0]
                dx = u[1] * w[2] - u[2] * w[1]
                dy = u[2] * w[0] - u[0] * w[2]
                dz = u[0] * w[1] - u[1] * w[0]
                place[kept, 0] = (offset[a] * bx + offset[b] * cx + half * dx) / whole
                place[kept, 1] = (offset[a] * by + offset[b] * cy + half * dy) / whole
                place[kept, 2] = (offset[a] * bz + offset[b] * cz + half * dz) / whole
                kept += 1
            count = kept
            planes += 1
            reach = 0.0
            for v in range(count):
                reach = max(reach, place[v, 0] ** 2 + place[v, 1] ** 2 + place[v, 2] ** 2)
        for k in range(6):
            sums[row, k] = 0.0
        if status[row] != 0:
            continue
        for v in range(count):
            x, y, z = place[v, 0], place[v, 1], place[v, 2]
            for k in range(3):
                a = ends[v, k]
                size = normal[a, 0] ** 2 + normal[a, 1] ** 2 + normal[a, 2] ** 2
                for axis in range(3):
                    foot[k, axis] = normal[a, axis] * offset[a] / size
            for k in range(3):
                after = (k + 1) % 3
                u, w = normal[ends[v, k]], normal[ends[v, after]]
                p, q = offset[ends[v, k]], offset[ends[v, after]]
                uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
                ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
                uw = u[0] * w[0] + u[1] * w[1] + u[2] * w[2]
                whole = uu * ww - uw * uw
                s, t = (p * ww - q * uw) / whole, (q * uu - p * uw) / whole
                ex = s * u[0] + t * w[0]
                ey = s * u[1] + t * w[1]
                ez = s * u[2] + t * w[2]
                for side in range(2):
                    f = foot[k] if side == 0 else foot[after]
                    six = (
                        f[0] * (ey * z - ez * y)
                        + f[1] * (ez * x - ex * z)
                        + f[2] * (ex * y - ey * x)
                    )
                    if side == 1:
                        six = -six
                    mx, my, mz = f[0] + ex + x, f[1] + ey + y, f[2] + ez + z
                    squares = (
                        f[0] ** 2 + f[1] ** 2 + f[2] ** 2
                        + ex * ex + ey * ey + ez * ez + x * x + y * y + z * z
                    )  # fmt: skip
                    mass = six / 6
                    sums[row, 5] += mass
                    if weighted:
                        mass *= _at(
                            density, origin, spacing,
                            here[0] + mx / 4, here[1] + my / 4, here[2] + mz / 4,
                        )  # fmt: skip
                    sums[row, 0] += mass
                    sums[row, 1] += mass * mx / 4
                    sums[row, 2] += mass * my / 4
                    sums[row, 3] += mass * mz / 4
                    sums[row, 4] += mass * (squares + mx * mx + my * my + mz * mz) / 20
