"""Plates, which are faces of the surface as thin panes between tubes, and the openings of faces."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import compiled
from ..mesh.geometry import face_frames
from ..mesh.polygons import Floats, Ints, PolygonMesh

DARK = 0.3
"""Smallest share of the surface's area that plates leave open, so that light gets out."""
BANDS, SECTORS = 8, 12
"""The checker pattern: number of bands over the height and of sectors around the axis."""


def choose(faces: PolygonMesh, share: float, pattern: str, random: np.random.Generator) -> Ints:
    """The sorted indices of a ``share`` of the faces, chosen by a ``pattern``.

    The patterns are random, even (far from each other), height (more at the bottom) and checker.
    There are fewer faces if less than DARK of the area would stay open.
    """
    count = faces.face_count
    wanted = round(share * count)
    if wanted == 0:
        return np.zeros(0, np.int64)
    area, _, centre = face_frames(faces)
    drawn = random.permutation(count)
    if pattern == "even":
        drawn = _far_apart(centre, wanted, int(drawn[0]))
    elif pattern == "height":
        rank = np.argsort(np.argsort(centre[:, 2], kind="stable"), kind="stable") / count
        drawn = np.argsort(rank + 0.5 * random.random(count), kind="stable")
    elif pattern == "checker":
        low, high = centre.min(axis=0), centre.max(axis=0)
        around = centre[:, :2] - 0.5 * (low + high)[:2]
        turn = np.arctan2(around[:, 1], around[:, 0]) / (2 * np.pi) + 0.5
        level = (centre[:, 2] - low[2]) / max(float((high - low)[2]), 1e-300)
        parity = (np.floor(BANDS * level) + np.floor(SECTORS * turn)) % 2 == 0
        drawn = drawn[parity[drawn]]
    drawn = drawn[:wanted]
    bright = np.cumsum(area[drawn]) <= (1 - DARK) * area.sum()
    return np.sort(drawn[bright])


def _far_apart(points: Floats, count: int, first: int) -> Ints:
    """Farthest-point sampling of ``count`` points that begins with ``first``."""
    chosen = np.empty(count, np.int64)
    distance = np.full(len(points), np.inf)
    for k in range(count):
        chosen[k] = first
        offset = points - points[first]
        distance = np.minimum(distance, np.einsum("ij,ij->i", offset, offset))
        first = int(distance.argmax())
    return chosen


def plates(faces: PolygonMesh, chosen: Ints, thickness: float) -> list[Any]:
    """A convex body for each chosen face: its corners, moved by half the thickness to both sides.

    The rim lies on the axes of the tubes, so that a plate that is no thicker than these always
    merges with them.
    """
    from manifold3d import Manifold

    _, normal, _ = face_frames(faces)
    bodies = []
    for face in chosen.tolist():
        ring = faces.face_vertices[faces.face_offsets[face] : faces.face_offsets[face + 1]]
        shift = 0.5 * thickness * normal[face]
        corners = faces.vertices[ring]
        bodies.append(Manifold.hull_points(np.concatenate([corners + shift, corners - shift])))
    return [body for body in bodies if not body.is_empty()]


def openings(faces: PolygonMesh, radii: Floats) -> Floats:
    """The radius ``(F,)`` of the largest circle that tubes leave open in each face.

    The tubes have ``radii (V,)`` at the corners. The radius is negative if they close the face. It
    is exact for convex, flat faces and tubes of one radius (linear programme of the Chebyshev
    centre).
    """
    _, normal, centre = face_frames(faces)
    helper = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, helper)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    second = np.cross(normal, first)
    owner = faces.corner_faces
    offset = faces.vertices[faces.face_vertices] - centre[owner]
    flat = np.stack(
        [np.einsum("ij,ij->i", offset, first[owner]), np.einsum("ij,ij->i", offset, second[owner])],
        axis=1,
    )
    found = np.empty(faces.face_count)
    _openings(faces.face_offsets, flat, radii[faces.face_vertices], found)
    return found


@compiled
def _openings(offsets: Any, corners: Any, radii: Any, found: Any) -> None:
    for face in range(len(offsets) - 1):
        start, count = offsets[face], offsets[face + 1] - offsets[face]
        # Constraints a x + b y + r <= c. Each line is moved inward by the thicker end of its tube.
        lines = np.empty((count, 3))
        kept = 0
        for k in range(count):
            p, q = start + k, start + (k + 1) % count
            dx, dy = corners[q, 0] - corners[p, 0], corners[q, 1] - corners[p, 1]
            length = np.sqrt(dx * dx + dy * dy)
            if length == 0.0:
                continue
            a, b = dy / length, -dx / length
            lines[kept, 0], lines[kept, 1] = a, b
            lines[kept, 2] = a * corners[p, 0] + b * corners[p, 1] - max(radii[p], radii[q])
            kept += 1
        best = -np.inf
        for i in range(kept):
            for j in range(i + 1, kept):
                for k in range(j + 1, kept):
                    a1, b1 = lines[i, 0] - lines[j, 0], lines[i, 1] - lines[j, 1]
                    a2, b2 = lines[i, 0] - lines[k, 0], lines[i, 1] - lines[k, 1]
                    c1, c2 = lines[i, 2] - lines[j, 2], lines[i, 2] - lines[k, 2]
                    both = a1 * b2 - a2 * b1
                    if abs(both) < 1e-12:
                        continue
                    x, y = (c1 * b2 - c2 * b1) / both, (a1 * c2 - a2 * c1) / both
                    radius = lines[i, 2] - lines[i, 0] * x - lines[i, 1] * y
                    if radius <= best:
                        continue
                    slack = np.inf
                    for m in range(kept):
                        slack = min(slack, lines[m, 2] - lines[m, 0] * x - lines[m, 1] * y - radius)
                    if slack >= -1e-9 * (1.0 + abs(radius)):
                        best = radius
        found[face] = best
