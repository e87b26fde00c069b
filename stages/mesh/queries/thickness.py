"""Thickness of a shape and of its gaps, measured by rays through a triangulation.

From it follow the edge lengths at which the spheres of opposite sheets do not contain each other's
generators.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..geometry import triangle_normals
from ..polygons import Floats, Ints

if TYPE_CHECKING:
    from ..creases import Creases
    from .triangle_tree import TriangleTree

FLAT, ROUND = 1.0, 0.5
"""Largest edge, divided by the thickness, at which the spheres of one sheet contain no generators
of the opposite one: first for a plate, then for a tube."""
OPPOSITE = -0.5
"""A ray has met an opposite sheet if the cosine of the two normals is less."""
BESIDE = 1e-6
"""Distance from the surface at which a ray starts, in units of h0."""
ASIDE, TURNED = 0.8, 0.6
"""A part is round if, ASIDE thicknesses beside a point, the cosine of the two
normals is less than TURNED."""
APEX = (0.5, 1.6)
"""Two sheets form a wedge at a crease if the distance to the crease, divided by the distance to the
line where the sheets would meet, is in this range."""
RIM = 2.2
"""Within this distance of a crease, in thicknesses, sheets form a wedge even if
they are not parallel."""


def across(
    tree: TriangleTree, normals: Floats, points: Floats, facing: Floats
) -> tuple[Floats, Floats]:
    """Distances ``(2, S)`` from points of a surface to the opposite sheet, and cosines ``(2, S)``.

    The first row goes through the shape, the second through the gap outside. Distances are infinite
    where there is no opposite sheet. The cosines are those of the two normals. The triangles of
    ``tree`` have ``normals (T, 3)``, and ``points (S, 3)`` have the normals ``facing (S, 3)``.
    """
    distance, cosine = np.full((2, len(points)), np.inf), np.ones((2, len(points)))
    for row, sign in enumerate((-1.0, 1.0)):
        way = sign * facing
        reach, hit = tree.first_met(points + BESIDE * way, way)
        met = np.flatnonzero(hit >= 0)
        cosine[row, met] = np.einsum("ij,ij->i", normals[hit[met]], facing[met])
        distance[row, met] = np.where(cosine[row, met] < OPPOSITE, reach[met] + BESIDE, np.inf)
    return distance, cosine


def thickness(vertices: Floats, triangles: Ints, owner: Ints) -> Floats:
    """The thickness ``(S,)`` at the centroids of the triangles ``owner (S,)``.

    It is that of the shape or of the gap outside, whichever is less, and infinite where there is no
    opposite sheet.
    """
    points = vertices[triangles[owner]].mean(axis=1)
    tree, normals = searched(vertices, triangles)
    return np.asarray(across(tree, normals, points, normals[owner])[0].min(axis=0))


def searched(vertices: Floats, triangles: Ints) -> tuple[TriangleTree, Floats]:
    """A tree of the triangles, and their unit normals ``(T, 3)``."""
    from .triangle_tree import TriangleTree  # numba, which it needs, is large

    return TriangleTree(vertices, triangles), triangle_normals(vertices, triangles)[0]


def thin_lengths(
    vertices: Floats,
    triangles: Ints,
    points: Floats,
    owner: Ints,
    creases: Creases | None,
    shortest_at_creases: float,
) -> Floats:
    """The longest edges ``(S,)`` that thin parts and gaps allow at ``points (S, 3)``.

    They are infinite where nothing is thin. Towards a crease where two sheets form a wedge, the
    thickness goes to zero. Edges there need not be shorter than ``shortest_at_creases``.
    """
    tree, normals = searched(vertices, triangles)
    facing = normals[owner]
    distance, cosine = across(tree, normals, points, facing)
    share = np.where(_round(tree, normals, points, facing, distance.min(axis=0)), ROUND, FLAT)
    if creases is not None:
        near = np.linalg.norm(points - creases.closest(points)[0], axis=1)
        floor = shortest_at_creases / share
        for row in range(2):
            angle = np.arccos(np.clip(-cosine[row], -1, 1))
            apex = distance[row] / np.maximum(np.tan(angle), 1e-6)
            wedge = (near > APEX[0] * apex) & (near < APEX[1] * apex)
            wedge |= near < RIM * distance[row]
            distance[row] = np.where(wedge, np.maximum(distance[row], floor), distance[row])
    return np.asarray(share * distance.min(axis=0))


def _round(
    tree: TriangleTree, normals: Floats, points: Floats, facing: Floats, thickness: Floats
) -> NDArray[np.bool_]:
    """Which of ``points`` lie on a part that curves within its own thickness, as a tube does.

    There the normal at the closest surface point differs for points beside them in the tangent
    plane.
    """
    turned = np.zeros(len(points), dtype=bool)
    thin = np.flatnonzero(np.isfinite(thickness))
    own = facing[thin]
    first = np.cross(own, np.eye(3)[np.abs(own).argmin(axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(float).tiny)
    for way in (first, -first, np.cross(own, first), -np.cross(own, first)):
        beside = points[thin] + ASIDE * thickness[thin, None] * way
        _, near, _ = tree.closest(beside)
        turned[thin] |= np.einsum("ij,ij->i", normals[near], own) < TURNED
    return turned
