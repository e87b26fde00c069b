"""Shape losses (paper, appendix A.1), which measure how far samples of the surface are from the
shape.

All lengths are in model units, so that they are already divided by h0.
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
"""Distance in units of h0 below which a sample counts as on the surface."""

NOISY = 0.05
"""Noise of a point cloud, in units of h0, above which the Chamfer loss takes points
of its reconstruction."""

ShapeLoss = Callable[[torch.Tensor, bool], torch.Tensor]
"""``loss(samples (N, 3), refresh)``. With ``refresh``, cached closest points are found again."""


def evaluate(
    loss: ShapeLoss | ImageLoss,
    vertices: torch.Tensor,
    frames: Frames,
    mesh: PolygonMesh,
    iteration: int,
    refresh: bool,
) -> torch.Tensor:
    """The ``loss`` of the polygons of ``mesh`` with ``vertices (V, 3)``."""
    if isinstance(loss, ImageLoss):
        return loss(vertices, frames, mesh, iteration)
    return loss(surface_samples(vertices, frames), refresh)


def surface_samples(vertices: torch.Tensor, frames: Frames) -> torch.Tensor:
    """Vertices, face centroids and centroids of fan triangles, ``(V + F + sum, 3)``."""
    return torch.cat([vertices, frames.centroid, frames.fan_centres])


def for_source(context: Context, frame: ModelFrame, kind: str) -> ShapeLoss | ImageLoss:
    """The loss of a ``kind``: distance, level-set, chamfer, images or paper.

    ``paper`` is the one of level-set, chamfer and images that fits the input. Raises UsageError if
    the input does not have what the loss needs.
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
        # A surface pulled to noisy points ends beside the true one. The targets are therefore the
        # closest points on the reconstruction.
        target = context.surface.closest(target)[0]
    return Chamfer(target, context.threads)


class Distance:
    """Mean squared distance of the samples to the true surface.

    Closest points are found when ``refresh`` is set. In between, the surface is replaced by the
    planes through them.
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
    """``mean (F / |grad F|)^2 / h0^2``, the squared distance to first order (Taubin 1994).

    A field may be flat at its surface, as the heart's is at its tip. Its level set then hardly
    pulls a surface, but this loss does. Its gradient treats ``|grad F|`` as fixed.
    """
    origin, spacing = torch.as_tensor(frame.origin), frame.spacing

    def loss(samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        at = (origin.to(samples.device) + spacing * samples.detach()).requires_grad_(True)
        value = level(at)
        (slope,) = torch.autograd.grad(value.sum(), at)
        steepness = torch.linalg.vector_norm(slope, dim=1).clamp(min=1e-12)
        direction = slope / steepness[:, None]
        distance = value.detach() / steepness / spacing
        # This is zero and has the direction as its gradient, so that the field is evaluated once.
        moved = ((samples - samples.detach()) * direction).sum(1)
        return torch.mean((distance + moved) ** 2)

    return loss


def level_set(level: Callable[[torch.Tensor], torch.Tensor], frame: ModelFrame) -> ShapeLoss:
    """``L_d = mean d(x_i)^2 / h0^2``, for a field with the value ``level`` at
    coordinates of the input."""
    origin, spacing = torch.as_tensor(frame.origin), frame.spacing

    def loss(samples: torch.Tensor, refresh: bool) -> torch.Tensor:
        values = level(origin.to(samples.device) + spacing * samples)
        return (values**2).mean() / spacing**2

    return loss


class Chamfer:
    """``L_pc``: the squared Chamfer distance to fixed target points ``(M, 3)``, in both directions.

    Nearest neighbours are found when ``refresh`` is set. The gradient treats them as fixed, which
    is exact where the nearest point is unique.
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
"""The unit normals ``(N, 3)`` and offsets ``(N,)`` of planes."""


def tangent_planes(surface: TrueSurface, samples: torch.Tensor, normals: Floats | None) -> Planes:
    """The plane for each sample through its closest surface point, perpendicular to the line to it.

    Raises NumericalFailure if a sample is not finite.
    """
    here = samples.detach().cpu().numpy()
    if not np.isfinite(here).all():
        raise NumericalFailure("a surface vertex is not finite: the training diverged")
    foot, outward = surface.closest(here, normals)
    way = here - foot
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    # For a sample on the surface the line has no direction; the surface normal replaces it.
    direction = np.where(distance > ON_SURFACE, way / np.maximum(distance, ON_SURFACE), outward)
    offset = (direction * foot).sum(axis=1)
    return (
        torch.as_tensor(direction, device=samples.device),
        torch.as_tensor(offset, device=samples.device),
    )


def to_planes(samples: torch.Tensor, planes: Planes) -> torch.Tensor:
    """The signed distances ``(N,)`` of samples to their planes."""
    return (samples * planes[0]).sum(1) - planes[1]
