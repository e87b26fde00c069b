"""The tensor product of cubic B-splines, in compiled code."""

from __future__ import annotations

import numpy as np

from ...compiled import compiled
from ...mesh.polygons import Floats


@compiled
def values_and_gradients(
    coefficients: Floats,
    origin: Floats,
    spacing: Floats,
    points: Floats,
    value: Floats,
    slope: Floats,
) -> None:
    """Writes ``value (N,)`` and ``slope (N, 3)`` of a spline that is mirrored in its outermost
    samples and beyond them grows with the square of the distance, at ``points (N, 3)``."""
    weight, change = np.empty((3, 4)), np.empty((3, 4))
    index, apart = np.empty((3, 4), np.int64), np.empty(3)
    mean = (spacing[0] + spacing[1] + spacing[2]) / 3
    for at in range(len(points)):
        for axis in range(3):
            last = coefficients.shape[axis] - 1
            place = (points[at, axis] - origin[axis]) / spacing[axis]
            within = min(max(place, 0.0), float(last))
            apart[axis] = spacing[axis] * (place - within)
            first = min(max(np.floor(within), 0.0), last - 1.0)
            t = within - first
            u = 1 - t
            weight[axis, 0] = u * u * u / 6
            weight[axis, 1] = (4 - 6 * t * t + 3 * t * t * t) / 6
            weight[axis, 2] = (4 - 6 * u * u + 3 * u * u * u) / 6
            weight[axis, 3] = t * t * t / 6
            change[axis, 0] = -u * u / 2
            change[axis, 1] = (3 * t * t - 4 * t) / 2
            change[axis, 2] = (4 * u - 3 * u * u) / 2
            change[axis, 3] = t * t / 2
            # At the point of the grid's surface that is nearest nothing changes along this axis.
            if within != place:
                change[axis, :] = 0.0
            for step in range(4):
                node = abs(int(first) + step - 1)
                index[axis, step] = node if node <= last else 2 * last - node
        total = dx = dy = dz = 0.0
        for i in range(4):
            for j in range(4):
                sums = ends = 0.0
                for k in range(4):
                    found = coefficients[index[0, i], index[1, j], index[2, k]]
                    sums += weight[2, k] * found
                    ends += change[2, k] * found
                total += weight[0, i] * weight[1, j] * sums
                dx += change[0, i] * weight[1, j] * sums
                dy += weight[0, i] * change[1, j] * sums
                dz += weight[0, i] * weight[1, j] * ends
        squares = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
        value[at] = total + squares / mean
        slope[at, 0] = dx / spacing[0] + 2 * apart[0] / mean
        slope[at, 1] = dy / spacing[1] + 2 * apart[1] / mean
        slope[at, 2] = dz / spacing[2] + 2 * apart[2] / mean
