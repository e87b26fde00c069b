"""Shape losses (paper's appendix A.1): how far surface samples lie from the target.

Everything is in model units: lengths divided by the spacing h0, about the grid's origin. The
paper's division by h0^2 is in that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ...errors import NumericalFailure, UsageError
from ...mesh.frames import Frames
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats, PolygonMesh
from .images import ImageLoss

if TYPE_CHECKING:
    from ...engine.stage import Context
    from ...mesh.queries.true_surface import TrueSurface

ON_SURFACE = 1e-6
"""Distance, in units of h0, below which a sample counts as on the surface."""

NOISY = 0.05
"""Noise of a point cloud, in units of h0, from which the Chamfer loss is the robust one."""

ShapeLoss = Callable[[torch.Tensor, bool], torch.Tensor]
"""``loss(samples (N, 3), refresh)``: with ``refresh`` cached neighbours are found anew."""


def evaluate(
    loss: ShapeLoss | ImageLoss,
    vertices: torch.Tensor,
    frames: Frames,
    mesh: PolygonMesh,
    iteration: int,
    refresh: bool,
) -> torch.Tensor:
    """``loss`` of the polygons of ``mesh`` over ``vertices (V, 3)``."""
    if isinstance(loss, ImageLoss):
        return loss(vertices, frames, mesh, iteration)
    return loss(surface_samples(vertices, frames), refresh)


def surface_samples(vertices: torch.Tensor, frames: Frames) -> torch.Tensor:
    """Face vertices, face centroids and fan-triangle centres, ``(V + F + sum, 3)``."""
    return torch.cat([vertices, frames.centroid, frames.fan_centres])


def for_source(context: Context, frame: ModelFrame, kind: str) -> ShapeLoss | ImageLoss:
    """The loss ``kind``: distance, level-set, chamfer, images, or paper for whichever of the last
    three fits.

    Raises UsageError when the input does not have it.
    """
    from ...inputs.field.source import FieldSource
    from ...inputs.views.source import ViewSource

    source, params = context.source(), context.params
    if isinstance(source, ViewSource) and kind in ("images", "paper"):
        views = source.views.in_frame(frame.origin, frame.spacing)
        return ImageLoss(views, context.seed, context.threads)
    if kind == "images":
        raise UsageError(
            f"--shape-loss images: the input is of kind {source.kind}, and only views have images"
        )
    if isinstance(source, FieldSource):
        if kind == "chamfer":
            raise UsageError(
                "--shape-loss chamfer: a field has no points to compare with; use level-set"
            )
        return (first_order_distance if kind == "distance" else level_set)(source.level, frame)
    if kind == "level-set":
        raise UsageError(
            f"--shape-loss level-set: an input of kind {source.kind} has no level set; use chamfer"
        )
    if kind == "distance":
        return Distance(context.surface)
    target = frame.model_from_input(
        source.surface_samples(params.target_samples, context.random("target"))
    )
    if source.noise > NOISY * frame.spacing:
        # The mean of what lies around a surface is not on it: robustly, its points are.
        target = context.surface.closest(target)[0]
    return Chamfer(target, context.threads)


class Distance:
    """Mean squared distance of the samples to the true surface.

    Closest points are found anew whenever ``refresh`` is set; in between they are taken as planes.
    """

    def __init__(self, surface: TrueSurface) -> None:
        self.surface = surface
        self.planes: Planes = (torch.zeros(0, 3), torch.zeros(0))

    def __call__(self, samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        if refresh or len(self.planes[0]) != len(samples):
            self.planes = tangent_planes(self.surface, samples, None)
        return (to_planes(samples, self.planes) ** 2).mean()


def first_order_distance(
    level: Callable[[torch.Tensor], torch.Tensor], frame: ModelFrame
) -> ShapeLoss:
    """``mean (F / |grad F|)^2 / h0^2``: the distance to the surface to first order (Taubin 1994).

    A field that is flat at its surface, as the heart's is at its tip, hardly holds a surface by
    its level set; this loss does. Its gradient takes ``|grad F|`` as fixed.
    """
    origin, spacing = torch.as_tensor(frame.origin), frame.spacing

    def loss(samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        at = (origin.to(samples.device) + spacing * samples.detach()).requires_grad_(True)
        value = level(at)
        (slope,) = torch.autograd.grad(value.sum(), at)
        steepness = torch.linalg.vector_norm(slope, dim=1).clamp(min=1e-12)
        direction = slope / steepness[:, None]
        distance = value.detach() / steepness / spacing
        # Zero in value, the direction in gradient: the field is evaluated only once.
        moved = ((samples - samples.detach()) * direction).sum(1)
        return torch.mean((distance + moved) ** 2)

    return loss


def level_set(level: Callable[[torch.Tensor], torch.Tensor], frame: ModelFrame) -> ShapeLoss:
    """``L_d = mean d(x_i)^2 / h0^2`` for a field with value ``level`` at input coordinates."""
    origin, spacing = torch.as_tensor(frame.origin), frame.spacing

    def loss(samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        values = level(origin.to(samples.device) + spacing * samples)
        return (values**2).mean() / spacing**2

    return loss


class Chamfer:
    """``L_pc``: bidirectional squared Chamfer distance to fixed target points ``(M, 3)``.

    Nearest neighbours are found by KD-trees whenever ``refresh`` is set and kept in between; the
    gradient treats them as fixed, as is exact wherever the nearest point is unique.
    """

    def __init__(self, target: Floats, threads: int) -> None:
        from scipy.spatial import cKDTree

        self.tree: Any = cKDTree(target)
        self.target = torch.as_tensor(target)
        self.threads = threads
        self.forward = self.backward = torch.zeros(0, dtype=torch.int64)

    def __call__(self, samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        from scipy.spatial import cKDTree

        target = self.target = self.target.to(samples.device)
        if refresh or len(self.forward) != len(samples):
            here = samples.detach().cpu().numpy()
            if not np.isfinite(here).all():
                raise NumericalFailure("a surface vertex is not finite: the training diverged")
            forward = self.tree.query(here, workers=self.threads)[1]
            own = cKDTree(here, balanced_tree=False, compact_nodes=False)
            backward = own.query(self.tree.data, workers=self.threads)[1]
            self.forward = torch.as_tensor(forward, device=samples.device)
            self.backward = torch.as_tensor(backward, device=samples.device)
        to_target = ((samples - target[self.forward]) ** 2).sum(1).mean()
        to_samples = ((target - samples.index_select(0, self.backward)) ** 2).sum(1).mean()
        return to_target + to_samples


Planes = tuple[torch.Tensor, torch.Tensor]
"""Unit normals ``(N, 3)`` and offsets ``(N,)`` of planes."""


def tangent_planes(surface: TrueSurface, samples: torch.Tensor, normals: Floats | None) -> Planes:
    """For each sample the plane through its closest surface point, across the way there.

    Raises NumericalFailure when a sample is not finite.
    """
    here = samples.detach().cpu().numpy()
    if not np.isfinite(here).all():
        raise NumericalFailure("a surface vertex is not finite: the training diverged")
    foot, outward = surface.closest(here, normals)
    way = here - foot
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    # On the surface the way has no direction; the normal there stands in.
    direction = np.where(distance > ON_SURFACE, way / np.maximum(distance, ON_SURFACE), outward)
    offset = (direction * foot).sum(axis=1)
    return (
        torch.as_tensor(direction, device=samples.device),
        torch.as_tensor(offset, device=samples.device),
    )


def to_planes(samples: torch.Tensor, planes: Planes) -> torch.Tensor:
    """Signed distances ``(N,)`` of samples to their planes."""
    return (samples * planes[0]).sum(1) - planes[1]
