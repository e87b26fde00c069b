"""Triangulation of flat regions that closed loops bound."""

from __future__ import annotations

import numpy as np

from .geometry import face_frames
from .polygons import Floats, Ints, PolygonMesh

FLAT = 0.1
"""Largest distance of a corner from the plane of its loop, divided by the size of the loop."""
EXACT = 1e-6
"""Largest relative error of the area of a triangulated region."""


def loop_polygons(vertices: Floats, loops: list[Ints]) -> PolygonMesh:
    """The ``loops`` of vertices as polygons."""
    offsets = np.cumsum([0, *(len(loop) for loop in loops)])
    return PolygonMesh(vertices, offsets.astype(np.int64), np.concatenate(loops))


def triangulated(vertices: Floats, loops: list[Ints], normal: Floats) -> Ints | None:
    """Triangles ``(T, 3)`` of the region that ``loops`` bound, seen along ``normal (3,)``.

    None if the loops are not flat or enclose no area.
    """
    from manifold3d import triangulate

    corners = np.concatenate(loops)
    at = vertices[corners] - vertices[loops[0]].mean(axis=0)
    if np.abs(at @ normal).max() > FLAT * np.ptp(vertices[loops[0]], axis=0).max():
        return None
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= np.linalg.norm(across)
    plane = np.stack([at @ across, at @ np.cross(normal, across)], axis=1)
    outlines = loop_polygons(vertices, loops)
    rings = [np.ascontiguousarray(ring) for ring in np.split(plane, outlines.face_offsets[1:-1])]
    found = np.asarray(triangulate(rings), np.int64)
    if len(found) == 0:
        return None
    a, b, c = (plane[found[:, k]] for k in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    size, facing, _ = face_frames(outlines)
    wanted = float(size @ (facing @ normal))
    if (areas <= 0).any() or abs(areas.sum() - wanted) > EXACT * wanted:
        return None
    return np.asarray(corners[found])
