"""Labels for the pairs of generators: which of the two is inside the trained surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.geometry import face_frames, fan_triangles
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.queries.parity import RayParity

CLOSER = 6
"""Number of times that a pair on one side is tried across the surface, with
half the distance each."""


@dataclass(frozen=True)
class Pairs:
    """The inside and the outside generator of each face, ``(F, 3)`` each."""

    inside: Floats
    outside: Floats
    relabelled: int
    """Number of pairs of faces whose normal points inward."""
    replaced: int
    """Number of pairs with both generators on one side of the surface, which were moved across the
    centroid of their face."""
    undecided: int
    """Number of pairs for which that failed, so that the normal of the face decided."""


def label_pairs(trained: PolygonMesh, ahead: Floats, behind: Floats) -> Pairs:
    """Decide which of ``ahead (F, 3)``, along the face normals, and ``behind (F, 3)`` is inside.

    A few trained faces may be folded over, with normals that point inward. If the normal decided,
    one such pair would add large false faces to the interface. If both generators are on one side,
    one of them may lie beyond all other generators, and the interface would be unbounded there.
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
