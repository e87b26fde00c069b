"""Losses of a surface seen by calibrated cameras (paper's appendix A.1): silhouettes, normals.

``Silhouettes`` needs no torch; ``ImageLoss`` makes a differentiable function of tensors of it.
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
"""Along a side of the pictures in which the loss is taken; larger ones are shrunk to about this."""
MASK, NORMAL = 10.0, 1.0
"""Weights of the two parts in the shape loss."""


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

    def __call__(self, vertices: Floats, triangles: Ints, chosen: Ints) -> Terms:
        """The terms over the views ``chosen``. Raises NumericalFailure for an open surface."""
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
        from ...render import visibility  # loads numba: 90 MB that only pictures need

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
    """Edges of a closed surface ``(E, 2)`` and the two triangles of each; an edge in which several
    sheets meet is there once for each. Raises NumericalFailure where one has no other side."""
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
    """``MASK L_mask + NORMAL L_normal`` of polygons, fanned about their centroids."""

    def __init__(self, views: Views, seed: int, threads: int) -> None:
        factor = max(1, round(max(views.masks.shape[1:]) / PIXELS))
        self.silhouettes = Silhouettes(views.shrunk(factor), threads)
        self.seed = seed

    def __call__(
        self, vertices: torch.Tensor, frames: Frames, mesh: PolygonMesh, iteration: int
    ) -> torch.Tensor:
        """Of the polygons of ``mesh`` over ``vertices (V, 3)``, in as many views as are taken in
        a step, at random."""
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
    """``L_mask`` and ``L_normal`` of closed ``triangles`` over ``vertices (V, 3)``, differentiable;
    which triangle a pixel sees, and whether its centre is covered, is taken as fixed."""
    import torch

    terms = silhouettes(vertices.detach().cpu().numpy(), triangles, chosen)
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
