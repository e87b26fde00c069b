"""Generator pairs of trained faces, labelled by a test for the inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.geometry import face_frames, fan_triangles
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.queries.parity import RayParity

CLOSER = 6
"""How often a pair on one side of the surface is moved across it, each time with half the
distance."""


@dataclass(frozen=True)
class Pairs:
    """``inside, outside (F, 3)``: the generators of face f."""

    inside: Floats
    outside: Floats
    relabelled: int
    """Pairs whose face normal pointed inward."""
    replaced: int
    """Pairs with both points on one side of the surface, which were moved across their face's
    centroid."""
    undecided: int
    """Pairs for which that failed, so that the orientation of the face decided."""


def label_pairs(trained: PolygonMesh, ahead: Floats, behind: Floats) -> Pairs:
    """Which of ``ahead (F, 3)`` (along the normal) and ``behind`` is inside the closed surface.

    A few trained faces are folded over and their normals point inward: one such pair labelled by
    its normal tears large false faces into the interface. Of a pair on one side one generator may
    even lie beyond all others, and the interface would have no end there.
    """
    vertices, triangles, _ = fan_triangles(trained)
    rays = RayParity(vertices, triangles)
    ahead, behind = ahead.copy(), behind.copy()
    ahead_inside, behind_inside = rays.inside(ahead), rays.inside(behind)
    left = astray = np.flatnonzero(ahead_inside == behind_inside)
    _, normal, centroid = face_frames(trained)
    reach = 0.5 * np.linalg.norm(ahead - behind, axis=1)[:, None] * normal
    for _ in range(CLOSER):
        if len(left) == 0:
            break
        places = centroid[left] + reach[left], centroid[left] - reach[left]
        first, second = (rays.inside(at) for at in places)
        good = first != second
        row = left[good]
        ahead[row], behind[row] = (at[good] for at in places)
        ahead_inside[row], behind_inside[row] = first[good], second[good]
        left = left[~good]
        reach *= 0.5
    swap = (ahead_inside & ~behind_inside)[:, None]
    return Pairs(
        inside=np.where(swap, ahead, behind),
        outside=np.where(swap, behind, ahead),
        relabelled=int(swap.sum()),
        replaced=len(astray) - len(left),
        undecided=len(left),
    )
