"""Losses of triangle faces, whose generator pairs are where three spheres meet.

With ``(c_v, r_v)`` free and the pair of a face in closed form, every sphere passes through the
generators of its faces by construction; what is left of conformity are inequalities: each pair
exists, and no other generator is inside a sphere. Lengths are divided by the local target length.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .sphere import power

OFFSET = 0.5
"""``delta_f`` below which a pair is penalised."""
MARGIN = 0.01
"""Power below which a generator that is not a sphere's own is penalised."""
SLOPE = 0.02
"""Of the linear part of that penalty, which does not fade as the last of it is worked off."""
SMALLEST_SQUARE = 1e-4
"""``delta_f^2`` that stands for a missing pair while there is none."""


@dataclass(frozen=True)
class Pairs:
    """Of every triangle: radical centre ``q (F, 3)``, ``delta_f^2 (F,)`` and normal ``(F, 3)``."""

    centre: torch.Tensor
    square: torch.Tensor
    normal: torch.Tensor

    def points(self, floor: torch.Tensor) -> torch.Tensor:
        """Outer, then inner generators ``(2F, 3)``; squares below ``floor (F,)`` are raised."""
        shift = torch.sqrt(torch.maximum(self.square, floor))[:, None] * self.normal
        return torch.cat([self.centre + shift, self.centre - shift])


def radical_pairs(centres: torch.Tensor, radii: torch.Tensor, triangles: torch.Tensor) -> Pairs:
    """Where the spheres at the corners of ``triangles (F, 3)`` meet: ``q +- delta n``.

    q is the point of the triangle's plane of equal power to the three spheres, and that power is
    ``-delta^2``.
    """
    a, b, c = (centres.index_select(0, triangles[:, k]) for k in range(3))
    wa, wb, wc = (radii.index_select(0, triangles[:, k]) ** 2 for k in range(3))
    u, v = b - a, c - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    cross = torch.linalg.cross(u, v)
    determinant = (cross * cross).sum(1) + 1e-20 * uu * vv + torch.finfo(u.dtype).tiny
    s, t = 0.5 * (uu + wa - wb), 0.5 * (vv + wa - wc)
    offset = ((vv * s - uv * t)[:, None] * u + (uu * t - uv * s)[:, None] * v) / determinant[
        :, None
    ]
    return Pairs(
        a + offset, wa - (offset * offset).sum(1), cross / torch.sqrt(determinant)[:, None]
    )


def existence(pairs: Pairs, length: torch.Tensor) -> torch.Tensor:
    """Mean of ``max(0, OFFSET^2 - delta^2 / l^2)^2``."""
    return ((OFFSET**2 - pairs.square / length**2).clamp(min=0) ** 2).mean()


def exclusion(
    points: torch.Tensor,
    centres: torch.Tensor,
    radii: torch.Tensor,
    length: torch.Tensor,
    pair_points: torch.Tensor,
    pair_spheres: torch.Tensor,
) -> torch.Tensor:
    """Sum over pairs of ``h^2 + SLOPE h`` with ``h = max(0, MARGIN - power / l^2)``, a sphere."""
    reach = power(
        points.index_select(0, pair_points),
        centres.index_select(0, pair_spheres),
        radii.index_select(0, pair_spheres),
    )
    hinge = (MARGIN - reach / length.index_select(0, pair_spheres) ** 2).clamp(min=0)
    return ((hinge**2).sum() + SLOPE * hinge.sum()) / len(centres)


def umbrella(values: torch.Tensor, ends: torch.Tensor, degree: torch.Tensor) -> torch.Tensor:
    """Values ``(V, k)`` less the mean over the ends of their edges ``(E, 2)``."""
    total = torch.zeros_like(values)
    total = total.index_add(0, ends[:, 0], values.index_select(0, ends[:, 1]))
    total = total.index_add(0, ends[:, 1], values.index_select(0, ends[:, 0]))
    return values - total / degree[:, None]
