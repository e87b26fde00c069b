"""The pairs of generators of triangles in closed form, and derivatives.

The spheres ``(c_v, r_v)`` are the unknowns. The pair of a face is where its three spheres meet, so
that every sphere passes through the generators of its faces by construction. What remains for
conformity are inequalities: each pair must exist, and no other generator may be inside a sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...mesh.polygons import Floats, Ints

FLAT = 1e-6
"""A generator is treated as fixed if the vectors from its face's centres to it are nearly coplanar:
if their triple product, divided by the product of their lengths, is less."""


@dataclass(frozen=True)
class Pairs:
    """The radical centre ``q (F, 3)``, ``delta_f^2 (F,)`` and the normal
    ``(F, 3)`` of every triangle."""

    centre: Floats
    square: Floats
    normal: Floats

    def points(self, floor: Floats) -> Floats:
        """The outer, then the inner generators, ``(2F, 3)``. Smaller squares than
        ``floor (F,)`` are raised."""
        shift = np.sqrt(np.maximum(self.square, floor))[:, None] * self.normal
        return np.concatenate([self.centre + shift, self.centre - shift])


def radical_pairs(centres: Floats, radii: Floats, triangles: Ints) -> Pairs:
    """The points ``q +- delta n`` where the spheres at the corners of ``triangles (F, 3)`` meet.

    q is the point in the triangle's plane with equal power to the three spheres. That power is
    ``-delta^2``.
    """
    a, b, c = (centres[triangles[:, k]] for k in range(3))
    wa, wb, wc = (radii[triangles[:, k]] ** 2 for k in range(3))
    u, v = b - a, c - a
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    cross = np.cross(u, v)
    determinant = np.einsum("ij,ij->i", cross, cross) + 1e-20 * uu * vv + np.finfo(float).tiny
    s, t = 0.5 * (uu + wa - wb), 0.5 * (vv + wa - wc)
    offset = (vv * s - uv * t)[:, None] * u + (uu * t - uv * s)[:, None] * v
    offset /= determinant[:, None]
    square = wa - np.einsum("ij,ij->i", offset, offset)
    return Pairs(a + offset, square, cross / np.sqrt(determinant)[:, None])


def power_gradient(
    points: Floats, own: Ints, spheres: Ints, centres: Floats, radii: Floats
) -> tuple[Ints, Floats]:
    """Derivatives of the powers ``|p - c_v|^2 - r_v^2`` of generators to other spheres.

    Row i is about generator ``points[i]`` of a face with corners ``own[i] (3,)``, and about sphere
    ``spheres[i]``. Returns columns ``(R, 16)``, indices of ``(c_v, r_v)`` stored as ``(V, 4)``, and
    the derivatives. A generator stays on its three spheres: ``(p - c_k) (dp - dc_k) = r_k dr_k``.
    One in the plane of its centres is treated as fixed.
    """
    arm = points[:, None] - centres[own]
    away = points - centres[spheres]
    # The inverse of the matrix of arms. There is none if they are coplanar, as for a triangle
    # without area.
    cross = np.cross(arm[:, [1, 2, 0]], arm[:, [2, 0, 1]])
    volume = np.einsum("ij,ij->i", arm[:, 0], cross[:, 0])
    flat = np.abs(volume) <= FLAT * np.prod(np.linalg.norm(arm, axis=2), axis=1)
    multiplier = 2 * np.einsum("ij,ikj->ik", away, cross) / np.where(flat, np.inf, volume)[:, None]
    moved = np.concatenate(
        [multiplier[:, :, None] * arm, (multiplier * radii[own])[:, :, None]], axis=2
    )
    still = -2 * np.concatenate([away, radii[spheres, None]], axis=1)
    columns = 4 * np.concatenate([own, spheres[:, None]], axis=1)[:, :, None] + np.arange(4)
    return columns.reshape(-1, 16), np.concatenate([moved.reshape(-1, 12), still], axis=1)


def square_gradient(
    centre: Floats, corners: Ints, centres: Floats, radii: Floats
) -> tuple[Ints, Floats]:
    """Derivatives of ``delta^2`` of faces with radical centres ``centre (R, 3)``.

    ``corners (R, 3)`` are the corners of the faces. Returns columns, indices of ``(V, 4)``, and
    values, ``(R, 12)`` each. ``-delta^2`` is the power of q to each of the spheres, and so the mean
    of these powers with the barycentric coordinates of q as weights. To first order, this mean does
    not change with q.
    """
    at = centres[corners]
    u, v, w = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0], centre - at[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    determinant = uu * vv - uv * uv
    # A triangle without area has no q.
    flat = determinant <= FLAT**2 * uu * vv
    determinant = np.where(flat, np.inf, determinant)
    s, t = (vv * wu - uv * wv) / determinant, (uu * wv - uv * wu) / determinant
    weight = np.where(flat[:, None], 0.0, np.stack([1 - s - t, s, t], axis=1))[:, :, None]
    value = 2 * weight * np.concatenate([centre[:, None] - at, radii[corners][:, :, None]], axis=2)
    return (4 * corners[:, :, None] + np.arange(4)).reshape(-1, 12), value.reshape(-1, 12)
