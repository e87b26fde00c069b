"""Losses of a surface seen by calibrated cameras (paper's appendix A.1): silhouettes, normals.

No torch is needed to evaluate them; ``Images`` has both as a differentiable function of tensors.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..render import visibility
from ..surface.edge_table import EdgeTable
from ..surface.polygons import Floats, Ints

if TYPE_CHECKING:
    import torch

    from ..render.cameras import Camera
    from ..render.views import Views

MOST_VIEWS = 66
"""Views in a step, at most (the paper's number)."""


@dataclass(frozen=True)
class Terms:
    """``L_mask`` with its derivatives by the vertices ``(V, 3)``, and what ``L_normal`` is linear
    in: it is ``offset`` less the sum of the products of the triangles' unit normals with ``votes
    (T, 3)``, for as long as no other triangles are seen."""

    mask: float
    mask_gradient: Floats
    votes: Floats
    offset: float


class Silhouettes:
    """A closed triangle surface before the cameras of some views."""

    def __init__(self, views: Views, threads: int) -> None:
        self.views, self.threads = views, threads

    def __call__(self, vertices: Floats, triangles: Ints, table: EdgeTable, chosen: Ints) -> Terms:
        """The terms over the views ``chosen``; ``table`` holds the edges of ``triangles``."""

        def one(number: int) -> tuple[float, Floats, Floats, float]:
            return self._one(int(number), vertices, triangles, table)

        if self.threads > 1:
            with ThreadPoolExecutor(self.threads) as pool:
                found = list(pool.map(one, chosen))
        else:
            found = [one(number) for number in chosen]
        share = 1 / len(chosen)
        return Terms(
            share * sum(each[0] for each in found),
            share * np.sum([each[1] for each in found], axis=0),
            share * np.sum([each[2] for each in found], axis=0),
            share * sum(each[3] for each in found),
        )

    def _one(
        self, number: int, vertices: Floats, triangles: Ints, table: EdgeTable
    ) -> tuple[float, Floats, Floats, float]:
        camera = self.views.cameras[number]
        screen = camera.project(vertices)
        seen = visible(camera, screen, triangles)
        target = self.views.masks[number] * np.float32(1 / 255)
        flat = np.zeros((len(vertices), 2))
        loss = visibility.silhouette(
            screen, table.ends, table.triangles, facing(screen, triangles), seen, target, flat
        )
        touched = np.flatnonzero(flat.any(axis=1))
        gradient = np.zeros((len(vertices), 3))
        gradient[touched] = np.einsum(
            "ni,nij->nj", flat[touched], camera.jacobian(vertices[touched])
        )
        votes = np.zeros((len(triangles), 3))
        weight = 0.0
        if self.views.normals is not None:
            weight = visibility.normals_seen(
                seen, self.views.normals[number], ray_matrix(camera), votes
            )
        if weight:
            votes /= weight
        return float(loss), gradient, votes, float(weight > 0)


def visible(camera: Camera, screen: Floats, triangles: Ints) -> Ints:
    """The triangle that each pixel centre sees ``(H, W)``, -1 for none; of a closed surface."""
    seen = np.empty((camera.height, camera.width), np.int32)
    nearest = np.empty((camera.height, camera.width))
    visibility.paint(screen, triangles, False, not camera.orthographic, seen, nearest)
    return seen


def facing(screen: Floats, triangles: Ints) -> Any:
    """Whether triangles are turned to the camera ``(T,)``."""
    a, b, c = (screen[triangles[:, k], :2] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def ray_matrix(camera: Camera) -> Floats:
    """``(3, 3)``: times (u, v, 1) it is along the ray through that pixel."""
    if camera.orthographic:
        return np.column_stack([np.zeros((3, 2)), camera.rotation[2]])
    return np.asarray(camera.rotation.T @ np.linalg.inv(camera.matrix))


def image_losses(
    silhouettes: Silhouettes, vertices: torch.Tensor, triangles: Ints, chosen: Ints
) -> tuple[torch.Tensor, torch.Tensor]:
    """``L_mask`` and ``L_normal`` of closed ``triangles`` over ``vertices (V, 3)``, differentiable;
    which triangle a pixel sees, and whether its centre is covered, is taken as fixed."""
    import torch

    table = EdgeTable.of(triangles)
    terms = silhouettes(vertices.detach().cpu().numpy(), triangles, table, chosen)
    slope = torch.as_tensor(terms.mask_gradient, device=vertices.device)
    # Zero in value, the slope in gradient.
    mask = terms.mask + ((vertices - vertices.detach()) * slope).sum()
    index = torch.as_tensor(triangles, device=vertices.device)
    a, b, c = (vertices.index_select(0, index[:, k]) for k in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    tiny = torch.finfo(vertices.dtype).tiny
    normals = cross / torch.sqrt((cross * cross).sum(1, keepdim=True) + tiny)
    votes = torch.as_tensor(terms.votes, device=vertices.device)
    return mask, terms.offset - (normals * votes).sum()
