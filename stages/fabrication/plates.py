"""Plates: faces of the surface as thin solid panes between the tubes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..surface.geometry import face_frames
from ..surface.polygons import Ints, PolygonMesh


def choose(face_count: int, share: float, random: np.random.Generator) -> Ints:
    """Indices of ``share`` of the faces, drawn at random, sorted."""
    return np.sort(random.permutation(face_count)[: round(share * face_count)])


def plates(faces: PolygonMesh, chosen: Ints, thickness: float) -> list[Any]:
    """A convex body per chosen face: its corners offset by half the thickness to either side.

    The rim lies on the tube axes, so a plate no thicker than the tubes always merges with them.
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
