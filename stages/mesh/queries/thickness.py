"""How thin a shape and its gaps are, measured on a triangulation by rays, and the edge lengths that
leave the spheres of opposite sheets room beside each other."""

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
"""Edge over the thickness of a plate, and over that of a tube, up to which the spheres of one sheet
leave out the generators of the other."""
OPPOSITE = -0.5
"""Cosine of two normals below which a ray has come to an opposite sheet."""
BESIDE = 1e-6
"""In units of h0: how far from the surface a ray starts."""
ASIDE, TURNED = 0.8, 0.6
"""A part is round where so many thicknesses aside the normal has a smaller cosine."""
APEX = (0.5, 1.6)
"""Distance of the nearest crease over that at which two sheets would meet, between which they do:
the thickness is that of a wedge."""
RIM = 2.2
"""In thicknesses: nearer to a crease the sheets need not be parallel."""


def across(
    tree: TriangleTree, normals: Floats, points: Floats, facing: Floats
) -> tuple[Floats, Floats]:
    """Distances ``(2, S)`` from ``points (S, 3)`` of a surface to the opposite sheet, through the
    shape and through the gap outside, infinity where there is none; and the cosines of the two
    normals. The triangles of ``tree`` have ``normals (T, 3)``, the points ``facing (S, 3)``."""
    distance, cosine = np.full((2, len(points)), np.inf), np.ones((2, len(points)))
    for row, sign in enumerate((-1.0, 1.0)):
        way = sign * facing
        reach, hit = tree.first_met(points + BESIDE * way, way)
        met = np.flatnonzero(hit >= 0)
        cosine[row, met] = np.einsum("ij,ij->i", normals[hit[met]], facing[met])
        distance[row, met] = np.where(cosine[row, met] < OPPOSITE, reach[met] + BESIDE, np.inf)
    return distance, cosine


def thickness(vertices: Floats, triangles: Ints, owner: Ints) -> Floats:
    """Of the shape or the gap, whichever is thinner, at the middle of triangles ``owner (S,)``;
    infinity where there is no opposite sheet."""
    points = vertices[triangles[owner]].mean(axis=1)
    tree, normals = searched(vertices, triangles)
    return np.asarray(across(tree, normals, points, normals[owner])[0].min(axis=0))


def searched(vertices: Floats, triangles: Ints) -> tuple[TriangleTree, Floats]:
    """A tree of the triangles, and their normals."""
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
    """The longest edges ``(S,)`` that thin parts and gaps allow at ``points``, infinity elsewhere.

    Towards a crease at which two sheets meet in a wedge the thickness goes to zero; edges beside
    it need not be shorter than ``shortest_at_creases``.
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
    """Which of ``points`` lie on a part that turns within its own thickness, as a tube does: the
    surface closest to a point beside them, in their tangent plane, faces another way."""
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
