"""The inner loops of rasterising, compiled by numba: visibility, silhouettes, and normals.

They release the interpreter's lock, so that threads draw several views at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import compiled


@compiled
def paint(
    screen: Any, triangles: Any, both: bool, positive: bool, seen: Any, nearest: Any
) -> None:  # pragma: no cover
    """Find the triangle of ``triangles (T, 3)`` that each pixel centre sees.

    ``screen (V, 3)`` has u, v and inverse depth of the vertices, as ``Camera.project`` gives them.
    The triangle is written to ``seen (H, W)``, -1 for none, and its inverse depth to
    ``nearest (H, W)``. Triangles that face away are skipped unless ``both`` is set. With
    ``positive``, triangles that have a corner behind the camera are skipped.
    """
    height, width = seen.shape
    seen[:] = -1
    nearest[:] = -np.inf
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = screen[a, 0], screen[a, 1], screen[a, 2]
        bx, by, bz = screen[b, 0], screen[b, 1], screen[b, 2]
        cx, cy, cz = screen[c, 0], screen[c, 1], screen[c, 2]
        if positive and (az <= 0 or bz <= 0 or cz <= 0):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0 or (area > 0 and not both):
            continue
        first = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
        last = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        left = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
        right = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        scale = 1 / area
        for row in range(first, last + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                wa = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * scale
                wb = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * scale
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * scale
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                near = wa * az + wb * bz + wc * cz
                if near > nearest[row, column]:
                    nearest[row, column] = near
                    seen[row, column] = t


@compiled
def crossings(
    screen: Any, ends: Any, sides: Any, facing: Any, seen: Any
) -> Any:  # pragma: no cover
    """Where the outline of the object crosses the lines between neighbouring pixel centres.

    Only pairs of centres count of which one sees the object, by ``seen (H, W)``, and the other does
    not. The outline consists of the edges ``ends (E, 2)`` whose two triangles ``sides (E, 2)``
    differ in ``facing (T,)``. If several of them cross a line, the outermost one counts.

    Returns two arrays ``(2, H, W)``, whose first index is 0 for pairs in a row and 1 for pairs in a
    column; entries are at the first pixel of a pair. The first array has the edge that crosses, or
    -1. The second has the distance of the crossing from the covered centre, in pixels.
    """
    height, width = seen.shape
    share = np.zeros((2, height, width), np.float32)
    owner = np.full((2, height, width), -1, np.int32)
    for e in range(len(ends)):
        if facing[sides[e, 0]] == facing[sides[e, 1]]:
            continue
        a, b = ends[e, 0], ends[e, 1]
        dx, dy = screen[b, 0] - screen[a, 0], screen[b, 1] - screen[a, 1]
        axis = 0 if abs(dy) >= abs(dx) else 1
        along, across = (1, 0) if axis == 0 else (0, 1)
        run = screen[b, along] - screen[a, along]
        if run == 0:
            continue
        size, most = (height, width - 2) if axis == 0 else (width, height - 2)
        first = max(0, int(np.ceil(min(screen[a, along], screen[b, along]) - 0.5)))
        last = min(size - 1, int(np.floor(max(screen[a, along], screen[b, along]) - 0.5)))
        slope = (screen[b, across] - screen[a, across]) / run
        for line in range(first, last + 1):
            place = screen[a, across] + (line + 0.5 - screen[a, along]) * slope
            low = int(np.floor(place - 0.5))
            if low < 0 or low > most:
                continue
            row, column = (line, low) if axis == 0 else (low, line)
            before = seen[row, column] >= 0
            if before == (seen[row + axis, column + 1 - axis] >= 0):
                continue
            s = place - 0.5 - low
            if not before:
                s = 1 - s
            if owner[axis, row, column] < 0 or s > share[axis, row, column]:
                share[axis, row, column] = s
                owner[axis, row, column] = e
    return owner, share


@compiled
def silhouette(
    screen: Any, ends: Any, sides: Any, facing: Any, seen: Any, target: Any, gradient: Any
) -> float:  # pragma: no cover
    """Mean squared difference between the coverage and ``target (H, W)``.

    Its derivatives by the pixel coordinates are added to ``gradient (V, 2)``. The other arguments
    are as in ``crossings``. The coverage of a pixel is 1 if its centre sees the object, else 0.
    Where the outline crosses at a distance s from the covered centre, ``s - 1/2`` is added to the
    pixel that contains the crossing, so that the coverage is continuous.
    """
    height, width = seen.shape
    owner, share = crossings(screen, ends, sides, facing, seen)
    off = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            off[row, column] = (1.0 if seen[row, column] >= 0 else 0.0) - target[row, column]
    for axis in range(2):
        for row in range(height):
            for column in range(width):
                if owner[axis, row, column] >= 0:
                    s = share[axis, row, column]
                    if (seen[row, column] >= 0) == (s <= 0.5):
                        off[row, column] += s - 0.5
                    else:
                        off[row + axis, column + 1 - axis] += s - 0.5
    total = 0.0
    for row in range(height):
        for column in range(width):
            total += off[row, column] ** 2
    scale = 2.0 / (height * width)
    for axis in range(2):
        along, across = (1, 0) if axis == 0 else (0, 1)
        for row in range(height):
            for column in range(width):
                e = owner[axis, row, column]
                if e < 0:
                    continue
                before = seen[row, column] >= 0
                if before == (share[axis, row, column] <= 0.5):
                    force = scale * off[row, column]
                else:
                    force = scale * off[row + axis, column + 1 - axis]
                if not before:
                    force = -force
                a, b = ends[e, 0], ends[e, 1]
                run = screen[b, along] - screen[a, along]
                part = ((row if axis == 0 else column) + 0.5 - screen[a, along]) / run
                slope = (screen[b, across] - screen[a, across]) / run
                gradient[a, across] += force * (1 - part)
                gradient[b, across] += force * part
                gradient[a, along] -= force * (1 - part) * slope
                gradient[b, along] -= force * part * slope
    return float(total / (height * width))


@compiled
def outline(
    screen: Any, ends: Any, sides: Any, facing: Any, seen: Any, distance: Any, found: Any
) -> None:  # pragma: no cover
    """Sum, for each edge, of values at the points where the outline crosses lines of pixel centres.

    Added to ``found (E, 5)``: the number of crossings, their positions along the edge from 0 to 1,
    ``distance (H, W)`` interpolated there, and its derivatives by u and by v. The other arguments
    are as in ``crossings``.
    """
    height, width = seen.shape
    owner, _ = crossings(screen, ends, sides, facing, seen)
    for axis in range(2):
        along, across = (1, 0) if axis == 0 else (0, 1)
        for row in range(height):
            for column in range(width):
                e = owner[axis, row, column]
                if e < 0:
                    continue
                a, b = ends[e, 0], ends[e, 1]
                line = row if axis == 0 else column
                part = (line + 0.5 - screen[a, along]) / (screen[b, along] - screen[a, along])
                place = screen[a, across] + part * (screen[b, across] - screen[a, across]) - 0.5
                u, v = (place, float(line)) if axis == 0 else (float(line), place)
                j = min(max(int(np.floor(u)), 0), width - 2)
                i = min(max(int(np.floor(v)), 0), height - 2)
                s, t = u - j, v - i
                p, q = distance[i, j], distance[i, j + 1]
                y, z = distance[i + 1, j], distance[i + 1, j + 1]
                found[e, 0] += 1
                found[e, 1] += part
                found[e, 2] += (1 - t) * ((1 - s) * p + s * q) + t * ((1 - s) * y + s * z)
                found[e, 3] += (1 - t) * (q - p) + t * (z - y)
                found[e, 4] += (1 - s) * (y - p) + s * (z - q)


@compiled
def normals_seen(seen: Any, target: Any, ray: Any, sums: Any) -> float:  # pragma: no cover
    """Add weighted normals of a picture to ``sums (T, 3)``, each to the triangle that its pixel
    sees.

    ``target (H, W, 3)`` has unit normals times 32767, zero where there is none. ``ray (3, 3)`` maps
    (u, v, 1) to a vector along the ray. For the cosine c of normal and ray the weight is
    ``exp(-c)`` if c is at most -0.1, else 1. Returns the sum of the weights.
    """
    height, width = seen.shape
    total = 0.0
    for row in range(height):
        y = row + 0.5
        for column in range(width):
            t = seen[row, column]
            if t < 0:
                continue
            nx = target[row, column, 0] / 32767.0
            ny = target[row, column, 1] / 32767.0
            nz = target[row, column, 2] / 32767.0
            if nx == 0 and ny == 0 and nz == 0:
                continue
            x = column + 0.5
            dx = ray[0, 0] * x + ray[0, 1] * y + ray[0, 2]
            dy = ray[1, 0] * x + ray[1, 1] * y + ray[1, 2]
            dz = ray[2, 0] * x + ray[2, 1] * y + ray[2, 2]
            c = (nx * dx + ny * dy + nz * dz) / np.sqrt(dx * dx + dy * dy + dz * dz)
            w = np.exp(-c) if c <= -0.1 else 1.0
            total += w
            sums[t, 0] += w * nx
            sums[t, 1] += w * ny
            sums[t, 2] += w * nz
    return total
