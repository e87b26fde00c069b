"""The paper's training of spheres with Adam (sections 3.3 and 3.4).

Targets lie on the normals through the centroids; spheres and offsets are free.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from ..mesh.frames import Connectivity, face_frames
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.spheres import initial_spheres, near_pairs
from ..solvers.adam import Schedule, adam
from .losses import regularization, sphere
from .losses.images import ImageLoss
from .losses.shape import ShapeLoss, evaluate

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..progress import Progress

NEIGHBOURS_EVERY = 10
"""Number of iterations between searches for spheres in which targets may lie."""
NEIGHBOUR_SLACK = 0.15
"""The search extends beyond a sphere by this share of its radius, because things
move between searches."""
CORRESPONDENCES_EVERY = 10
"""Number of iterations between searches for the closest points of the shape loss."""


def train(
    mesh: PolygonMesh,
    shape_loss: ShapeLoss | ImageLoss,
    weights: Mapping[str, float],
    schedule: Schedule,
    checkpoints: Checkpoints,
    progress: Progress,
    device: str,
    threads: int,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres ``(V, 3)``, radii ``(V,)``, offsets ``delta_f (F,)``, and losses ``(iterations, 4)``.

    Offsets may have either sign. The columns of the losses are named as ``weights``: intersection,
    exclusion, shape, normal.
    """
    first_radii, first_offsets = initial_spheres(mesh)
    parameters = {
        name: torch.tensor(values, device=device).requires_grad_(True)
        for name, values in (
            ("centres", mesh.vertices), ("radii", first_radii), ("offsets", first_offsets)
        )
    }  # fmt: skip
    centres, radii, offsets = parameters.values()
    connectivity = Connectivity.of(mesh, device)
    near: list[torch.Tensor] = []

    def losses(iteration: int) -> dict[str, torch.Tensor]:
        frames = face_frames(centres, connectivity)
        outer, inner = sphere.targets(frames.centroid, frames.normal, offsets)
        points = torch.cat([outer, inner])
        if iteration % NEIGHBOURS_EVERY == 0 or not near:
            found = near_pairs(
                mesh,
                points.detach().cpu().numpy(),
                centres.detach().cpu().numpy(),
                radii.detach().abs().cpu().numpy(),
                NEIGHBOUR_SLACK,
                threads,
            )
            near[:] = [torch.as_tensor(index, device=device) for index in found]
        return {
            "intersection": sphere.intersection(
                outer, inner, centres, radii, connectivity.corner_faces, connectivity.corners
            ),
            "exclusion": sphere.exclusion(points, centres, radii, near[0], near[1]),
            "shape": evaluate(
                shape_loss,
                centres,
                frames,
                mesh,
                iteration,
                iteration % CORRESPONDENCES_EVERY == 0,
            ),
            "normal": regularization.normal_consistency(frames, connectivity),
        }

    history = adam(parameters, losses, weights, schedule, checkpoints, progress, "sphere-train")
    # The losses depend on the squares of radii only, so a step may lead through zero.
    found = [tensor.detach().cpu().numpy() for tensor in (centres, radii.abs(), offsets)]
    return found[0], found[1], found[2], history
