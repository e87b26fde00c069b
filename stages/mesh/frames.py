"""Areas, normals and centroids of faces as torch tensors, for losses.

``geometry`` computes the same with numpy. Rows are gathered with ``index_select``, because the
gradient of plain indexing takes several times as long.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .polygons import PolygonMesh
from .topology import face_neighbours


@dataclass(frozen=True)
class Connectivity:
    """The index arrays of a polygon mesh as tensors. They are made once for each topology."""

    face_count: int
    corner_faces: torch.Tensor
    corners: torch.Tensor
    following: torch.Tensor
    valences: torch.Tensor
    neighbours: torch.Tensor
    """The pairs of faces that share an edge, in both orders, ``(P, 2)``."""

    @classmethod
    def of(cls, mesh: PolygonMesh, device: str = "cpu") -> Connectivity:
        """The connectivity of ``mesh`` on ``device``."""

        def tensor(array: object) -> torch.Tensor:
            return torch.as_tensor(array, device=device)

        return cls(
            mesh.face_count,
            tensor(mesh.corner_faces),
            tensor(mesh.face_vertices),
            tensor(mesh.next_vertices),
            tensor(mesh.valences).to(torch.float64),
            tensor(face_neighbours(mesh)),
        )

    def face_sum(self, values: torch.Tensor) -> torch.Tensor:
        """The sum ``(F, ...)`` over each face of values at its corners, ``(sum, ...)``."""
        result = values.new_zeros(self.face_count, *values.shape[1:])
        return result.index_add(0, self.corner_faces, values)

    def neighbour_mean(self, values: torch.Tensor) -> torch.Tensor:
        """The mean of face values ``(F, k)`` over the neighbours of each face."""
        face, other = self.neighbours[:, 0], self.neighbours[:, 1]
        total = torch.zeros_like(values).index_add(0, face, values.index_select(0, other))
        count = torch.bincount(face, minlength=self.face_count).clamp(min=1)
        return total / count[:, None]


@dataclass(frozen=True)
class Frames:
    """Area ``(F,)``, unit normal ``(F, 3)`` and area centroid ``(F, 3)`` of each face."""

    area: torch.Tensor
    normal: torch.Tensor
    centroid: torch.Tensor
    fan_centres: torch.Tensor
    """Centroids ``(sum, 3)`` of the triangles (face centroid, corner, next corner)."""


def face_frames(vertices: torch.Tensor, connectivity: Connectivity) -> Frames:
    """The frames of all faces with ``vertices (V, 3)``, as
    ``geometry.face_frames`` defines them."""
    tiny = torch.finfo(vertices.dtype).tiny
    here = vertices.index_select(0, connectivity.corners)
    following = vertices.index_select(0, connectivity.following)
    apex = connectivity.face_sum(here) / connectivity.valences[:, None]
    at = apex.index_select(0, connectivity.corner_faces)
    fans = 0.5 * torch.linalg.cross(here - at, following - at)
    vector_area = connectivity.face_sum(fans)
    area = torch.sqrt((vector_area * vector_area).sum(1) + tiny)
    normal = vector_area / area[:, None]
    weight = (fans * normal.index_select(0, connectivity.corner_faces)).sum(1, keepdim=True)
    offset = connectivity.face_sum(weight * (here + following - 2 * at)) / 3
    centroid = apex + offset / area[:, None]
    centres = (here + following + centroid.index_select(0, connectivity.corner_faces)) / 3
    return Frames(area, normal, centroid, centres)
