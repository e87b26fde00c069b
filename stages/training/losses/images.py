"""Losses that compare a surface with views (paper, appendix A.1): silhouettes and normals.

``Silhouettes`` needs no torch. ``ImageLoss`` is a differentiable function of tensors.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...artifacts.randomness import generator
from ...errors import NumericalFailure
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...render.cameras import facing, ray_matrix, visible
from ...render.views import MOST_VIEWS

if TYPE_CHECKING:
    import torch

    from ...mesh.frames import Frames
    from ...render.views import Views

PIXELS = 256
"""Approximate width of the pictures in which the loss is computed. Larger ones are shrunk."""
MASK, NORMAL = 10.0, 1.0
"""Weights of the silhouette loss and of the normal loss."""


@dataclass(frozen=True)
class Terms:
    """``L_mask`` with its derivatives by the vertices ``(V, 3)``, and the coefficients of
    ``L_normal``.

    ``L_normal`` is ``offset`` minus the sum of the scalar products of the triangles' unit normals
    and ``votes (T, 3)``, as long as the same triangles are visible.
    """

    mask: float
    mask_gradient: Floats
    votes: Floats
    offset: float


class Silhouettes:
    """A function of a closed triangle surface, for the cameras of some views."""

    def __init__(self, views: Views, threads: int) -> None:
        self.views, self.threads = views, threads

    def __call__(self, vertices: Floats, triangles: Ints, chosen: Ints) -> Terms:
        """The terms over the views ``chosen``. Raises NumericalFailure if the
        surface is not closed."""
        edges = edge_pairs(triangles)

        def one(number: int) -> tuple[float, Floats, Floats, float]:
            return self._one(int(number), vertices, triangles, *edges)

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
        self, number: int, vertices: Floats, triangles: Ints, ends: Ints, sides: Ints
    ) -> tuple[float, Floats, Floats, float]:
        from ...render import visibility  # loads numba, which takes 90 MB that only views need

        camera = self.views.cameras[number]
        screen = camera.project(vertices)
        seen = visible(camera, screen, triangles)
        target = self.views.masks[number] * np.float32(1 / 255)
        flat = np.zeros((len(vertices), 2))
        loss = visibility.silhouette(
            screen, ends, sides, facing(screen, triangles), seen, target, flat
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


def edge_pairs(triangles: Ints) -> tuple[Ints, Ints]:
    """The edges ``(E, 2)`` of a closed surface, and the two triangles of each ``(E, 2)``.

    An edge in which several sheets meet appears once for each. Raises NumericalFailure if an edge
    has only one triangle.
    """
    count = len(triangles)
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    key = np.minimum(start, end) * (int(triangles.max()) + 1) + np.maximum(start, end)
    up = np.flatnonzero(start < end)
    down = np.flatnonzero(start > end)
    up, down = (half[np.argsort(key[half], kind="stable")] for half in (up, down))
    if 2 * len(up) != 3 * count or not np.array_equal(key[up], key[down]):
        raise NumericalFailure("the surface is not closed and cannot be compared with pictures")
    return np.stack([start[up], end[up]], axis=1), np.stack([up // 3, down // 3], axis=1)


class ImageLoss:
    """``MASK L_mask + NORMAL L_normal`` of polygons, which become fans about their centroids."""

    def __init__(self, views: Views, seed: int, threads: int) -> None:
        factor = max(1, round(max(views.masks.shape[1:]) / PIXELS))
        self.silhouettes = Silhouettes(views.shrunk(factor), threads)
        self.seed = seed

    def __call__(
        self, vertices: torch.Tensor, frames: Frames, mesh: PolygonMesh, iteration: int
    ) -> torch.Tensor:
        """The loss of the polygons of ``mesh`` with ``vertices (V, 3)``, in a
        random choice of views."""
        import torch

        count = len(self.silhouettes.views)
        chosen = np.arange(count)
        if count > MOST_VIEWS:
            random = generator(self.seed, "losses", "views", iteration)
            chosen = np.sort(random.permutation(count)[:MOST_VIEWS])
        middle = len(mesh.vertices) + mesh.corner_faces
        triangles = np.stack([middle, mesh.face_vertices, mesh.next_vertices], axis=1)
        mask, normal = image_losses(
            self.silhouettes, torch.cat([vertices, frames.centroid]), triangles, chosen
        )
        return MASK * mask + NORMAL * normal


def image_losses(
    silhouettes: Silhouettes, vertices: torch.Tensor, triangles: Ints, chosen: Ints
) -> tuple[torch.Tensor, torch.Tensor]:
    """``L_mask`` and ``L_normal`` of closed ``triangles`` with ``vertices (V, 3)``, with gradients.

    The gradients treat as fixed which triangle a pixel sees, and whether its centre is covered.
    """
    import torch

    terms = silhouettes(vertices.detach().cpu().numpy(), triangles, chosen)
    slope = torch.as_tensor(terms.mask_gradient, device=vertices.device)
    # The added term is zero and has the slope as its gradient.
    mask = terms.mask + ((vertices - vertices.detach()) * slope).sum()
    index = torch.as_tensor(triangles, device=vertices.device)
    a, b, c = (vertices.index_select(0, index[:, k]) for k in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    tiny = torch.finfo(vertices.dtype).tiny
    normals = cross / torch.sqrt((cross * cross).sum(1, keepdim=True) + tiny)
    votes = torch.as_tensor(terms.votes, device=vertices.device)
    return mask, terms.offset - (normals * votes).sum()
