"""Voronoi vertices: circumcentres of tetrahedra, in closed form and with gradients."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .delaunay import Floats, Ints

if TYPE_CHECKING:
    import torch


FLAT = 1e-9
"""A tetrahedron with a smaller ``|det| / Lmax^3`` has no usable circumcentre."""


def circumcentres(generators: Floats, tetrahedra: Ints) -> tuple[Floats, Floats]:
    """Circumcentres ``(T, 3)`` and flatness ``|det| / Lmax^3 (T,)`` of ``tetrahedra (T, 4)``.

    Corners are taken in ascending order, so that a tetrahedron has the same circumcentre, to the
    last bit, in every diagram. A flat tetrahedron gets the mean of its corners.
    """
    corners = generators[np.sort(tetrahedra, axis=1)]
    base = corners[:, 0]
    edges = corners[:, 1:] - base[:, None]
    squares = np.einsum("tij,tij->ti", edges, edges)
    cross = np.stack(
        [np.cross(edges[:, (k + 1) % 3], edges[:, (k + 2) % 3]) for k in range(3)], axis=1
    )
    determinant = np.einsum("ti,ti->t", edges[:, 0], cross[:, 0])
    longest = np.sqrt(squares.max(axis=1))
    flatness = np.abs(determinant) / np.maximum(longest, np.finfo(float).tiny) ** 3
    usable = flatness > 1e-15
    safe = np.where(usable, determinant, 1.0)
    offset = 0.5 * np.einsum("ti,tij->tj", squares, cross) / safe[:, None]
    offset[~usable] = edges[~usable].sum(axis=1) / 4
    return base + offset, flatness


def voronoi_vertices(generators: torch.Tensor, tetrahedra: torch.Tensor) -> torch.Tensor:
    """Circumcentres ``(T, 3)`` with gradients by ``generators (N, 3)``.

    Solves ``A v = b / 2`` (paper, appendix C.1, after Numerow et al. 2024). Differentiating
    ``|x_i - v|^2 = |x_0 - v|^2`` gives ``A dv = ((x_i - v) dx_i - (x_0 - v) dx_0)_i``. So with
    ``A^T u = dL/dv`` the gradients are ``u_i (x_i - v)`` and ``-(sum u)(x_0 - v)``. A flat
    tetrahedron has no circumcentre: it gives the mean of its corners and no gradient.
    """
    result: torch.Tensor = _circumcentre_function().apply(generators, tetrahedra)
    return result


_FUNCTION: list[Any] = []


def _circumcentre_function() -> Any:
    if _FUNCTION:
        return _FUNCTION[0]
    import torch

    def cofactors(edges: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        a, b, c = edges.unbind(1)
        cross = torch.stack(
            [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1
        )
        return cross, (a * cross[:, 0]).sum(1)

    class Circumcentre(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, generators: torch.Tensor, tetrahedra: torch.Tensor) -> torch.Tensor:
            corners = generators[tetrahedra]
            edges = corners[:, 1:] - corners[:, :1]
            cross, determinant = cofactors(edges)
            squares = (edges * edges).sum(2)
            flat = determinant.abs() < FLAT * squares.amax(1) ** 1.5
            determinant = torch.where(flat, torch.inf, determinant)
            offset = 0.5 * (squares[:, :, None] * cross).sum(1) / determinant[:, None]
            offset = torch.where(flat[:, None], edges.sum(1) / 4, offset)
            ctx.save_for_backward(corners - (corners[:, 0] + offset)[:, None], cross, determinant)
            ctx.tetrahedra, ctx.count = tetrahedra, len(generators)
            return corners[:, 0] + offset

        @staticmethod
        def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
            arms, cross, determinant = ctx.saved_tensors
            multipliers = (cross * gradients[0][:, None]).sum(2) / determinant[:, None]
            weights = torch.cat([-multipliers.sum(1, keepdim=True), multipliers], dim=1)
            result = arms.new_zeros(ctx.count, 3)
            result.index_add_(
                0, ctx.tetrahedra.reshape(-1), (weights[:, :, None] * arms).reshape(-1, 3)
            )
            return result, None

    _FUNCTION.append(Circumcentre)
    return Circumcentre
