"""The sphere-intersection loss (paper, section 3.4): the spheres of a face
meet in its two targets."""

from __future__ import annotations

import torch

EXCLUSION_MARGIN = 1e-13
"""``m`` of the paper's exclusion loss, in units of h0^2."""


def power(points: torch.Tensor, centres: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
    """The power distance ``g(p, c, r) = |p - c|^2 - r^2``."""
    return ((points - centres) ** 2).sum(-1) - radii**2


def targets(
    centroid: torch.Tensor, normal: torch.Tensor, offset: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The targets ``p_f^(1,2) = c_f +- delta_f n_f`` (equation 2), outer first, ``(F, 3)`` each."""
    shift = offset[:, None] * normal
    return centroid + shift, centroid - shift


def intersection(
    outer: torch.Tensor,
    inner: torch.Tensor,
    centres: torch.Tensor,
    radii: torch.Tensor,
    corner_faces: torch.Tensor,
    corners: torch.Tensor,
) -> torch.Tensor:
    """``L_int`` (equation 3): the mean squared power of the targets to the spheres of their face.

    ``outer`` and ``inner`` are ``(F, 3)``, ``centres (V, 3)``, ``radii (V,)``. ``corner_faces`` and
    ``corners`` are the N_pairs pairs of a face and a sphere at its corner.
    """
    spheres, radius = centres.index_select(0, corners), radii.index_select(0, corners)
    return 0.5 * (
        (power(outer.index_select(0, corner_faces), spheres, radius) ** 2).mean()
        + (power(inner.index_select(0, corner_faces), spheres, radius) ** 2).mean()
    )


def exclusion(
    points: torch.Tensor,
    centres: torch.Tensor,
    radii: torch.Tensor,
    pair_points: torch.Tensor,
    pair_spheres: torch.Tensor,
    margin: float = EXCLUSION_MARGIN,
) -> torch.Tensor:
    """``L_excl`` (equation 4): the mean of ``max(0, m - g)^2`` over the pairs that violate it.

    ``pair_points`` are indices of ``points (2F, 3)``, ``pair_spheres`` of spheres that are not at
    the corners of their face.
    """
    distance = power(
        points.index_select(0, pair_points),
        centres.index_select(0, pair_spheres),
        radii.index_select(0, pair_spheres),
    )
    hinge = (margin - distance).clamp(min=0)
    return (hinge**2).sum() / (hinge > 0).sum().clamp(min=1)
