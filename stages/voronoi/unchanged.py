"""Whether adding generators left an interface as it was."""

from __future__ import annotations

import numpy as np

from ..surface.geometry import face_frames
from .delaunay import Floats, Ints
from .interface import VoronoiSurface
from .vertices import FLAT

AREA_TOLERANCE = 1e-9
"""Relative to the mean face area; smaller faces come and go with rounding in flat tetrahedra."""


def same_surface(
    before: VoronoiSurface, after: VoronoiSurface, boundary: Floats, added: int
) -> str | None:
    """None if ``after`` is ``before`` although ``added`` generators were put in front of its list;
    else what differs.

    Faces are matched by their generators, vertices by the four generators they are equidistant
    to, and then compared bit by bit; flat tetrahedra and faces without area may differ.
    """
    count = len(boundary)
    pairs = after.generators - added
    if (pairs < 0).any():
        return f"{int((pairs < 0).any(axis=1).sum())} faces belong to added generators"
    areas = []
    for surface, generators in ((before, before.generators), (after, pairs)):
        area = face_frames(surface.mesh)[0]
        real = area > AREA_TOLERANCE * area.mean()
        areas.append(dict.fromkeys((generators[real] @ np.array([count, 1])).tolist()))
    changed = areas[0].keys() ^ areas[1].keys()
    if changed:
        return f"{len(changed)} faces"
    old, new = (_by_tetrahedron(surface, shift) for surface, shift in ((before, 0), (after, added)))
    common = np.intersect1d(old[0], new[0], return_indices=True)
    missing = len(old[0]) + len(new[0]) - 2 * len(common[0])
    if missing:
        return f"{missing} vertices"
    if not np.array_equal(old[1][common[1]], new[1][common[2]]):
        return "positions of vertices"
    return None


def _by_tetrahedron(surface: VoronoiSurface, shift: int) -> tuple[Ints, Floats]:
    sound = surface.flatness >= FLAT
    corners = np.sort(surface.tetrahedra[sound] - shift, axis=1)
    keys = np.ascontiguousarray(corners).view([("", np.int64)] * 4).reshape(-1)
    order = np.argsort(keys)
    return keys[order], surface.mesh.vertices[sound][order]
