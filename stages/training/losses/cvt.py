"""The paper's CVT loss, which measures how far generators are from the centroids of their cells."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...voronoi.diagram.delaunay import Ints, in_passing
from ...voronoi.diagram.rings import Selection, ring_mesh, voronoi_rings
from ...voronoi.diagram.vertices import voronoi_vertices


def _touching(count: int) -> Selection:
    """Selects every face of the first ``count`` generators once."""

    def select(a: Ints, b: Ints) -> NDArray[np.int8]:
        forward = (a < b).astype(np.int8)
        return np.where(np.minimum(a, b) < count, 2 * forward - 1, 0).astype(np.int8)

    return select


def centroid_offsets(points: torch.Tensor, fixed: torch.Tensor) -> torch.Tensor:
    """The vectors ``cbar_i - p_i (M, 3)`` from generators ``points (M, 3)`` to their cells'
    centroids.

    The diagram is that of ``points`` and ``fixed (K, 3)``. Gradients go through the Voronoi
    vertices (Numerow et al. 2024), while the connectivity is fixed. Raises NumericalFailure if a
    cell is unbounded.
    """
    generators, count = torch.cat([points, fixed]), len(points)
    places = generators.detach().numpy()
    diagram = in_passing(places)
    rings = voronoi_rings(places, diagram, _touching(count))
    mesh, used = ring_mesh(rings)
    vertices = voronoi_vertices(generators, torch.as_tensor(diagram.corners[used]))
    face = torch.as_tensor(mesh.corner_faces)
    here = vertices[torch.as_tensor(mesh.face_vertices)]
    after = vertices[torch.as_tensor(mesh.next_vertices)]
    apex = here.new_zeros(mesh.face_count, 3).index_add(0, face, here)
    apex = (apex / torch.as_tensor(mesh.valences)[:, None])[face]
    volume, moment = here.new_zeros(count), here.new_zeros(count, 3)
    for side, sign in ((0, 1.0), (1, -1.0)):
        cell = torch.as_tensor(rings.generators[:, side])[face]
        mine = cell < count
        cell = cell[mine]
        a, b, c = (corner[mine] - generators[cell] for corner in (apex, here, after))
        each = sign / 6 * (a * torch.linalg.cross(b, c)).sum(1)
        volume = volume.index_add(0, cell, each)
        moment = moment.index_add(0, cell, each[:, None] * (a + b + c) / 4)
    return moment / volume[:, None]


def cvt(points: torch.Tensor, fixed: torch.Tensor, mean_area: float) -> torch.Tensor:
    """``L_CVT = mean_i |p_i - cbar_i|^2 / Abar`` (paper's section 3.6)."""
    return (centroid_offsets(points, fixed) ** 2).sum(1).mean() / mean_area
