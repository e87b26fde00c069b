"""Generator pairs of trained faces, labelled by the inside test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sources.parity import RayParity
from ..surface.geometry import fan_triangles
from ..surface.polygons import Floats, PolygonMesh


@dataclass(frozen=True)
class Pairs:
    """``inside, outside (F, 3)``: the generators of face f."""

    inside: Floats
    outside: Floats
    relabelled: int
    """Pairs whose face normal pointed inward."""
    undecided: int
    """Pairs with both points on one side of the surface; the face's orientation decided."""


def label_pairs(trained: PolygonMesh, ahead: Floats, behind: Floats) -> Pairs:
    """Which of ``ahead (F, 3)`` (along the normal) and ``behind`` is inside the closed surface.

    A few trained faces are folded over and their normals point inward: one such pair labelled by
    its normal tears large false faces into the interface.
    """
    vertices, triangles, _ = fan_triangles(trained)
    rays = RayParity(vertices, triangles)
    ahead_inside, behind_inside = rays.inside(ahead), rays.inside(behind)
    swap = (ahead_inside & ~behind_inside)[:, None]
    return Pairs(
        inside=np.where(swap, ahead, behind),
        outside=np.where(swap, behind, ahead),
        relabelled=int(swap.sum()),
        undecided=int((ahead_inside == behind_inside).sum()),
    )
