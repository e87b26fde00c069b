"""Agreement between the Voronoi interface of the generators and the trained surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.geometry import face_frames
from .diagram.interface import VoronoiSurface
from .trained_surface import TrainedSurface


@dataclass(frozen=True)
class Conformity:
    """Measures of the computed diagram before any merging. Squared lengths are
    divided by spacing^2."""

    pair_area_share: float
    """Area of the interface faces between the two generators of one trained face, divided by the
    area of the interface."""
    pair_faces: int
    """Number of trained faces whose pair shares a face in the diagram."""
    trained_faces: int
    interface_faces: int
    residual_max: float
    """Largest ``|power|`` of a generator to a sphere at its face's corners."""
    residual_rms: float
    intrusion: float
    """The most negative power of a generator to a sphere that is not of its
    face; 0 without intruders."""


def conformity(
    surface: VoronoiSurface, trained: TrainedSurface, threads: int = 1, spacing: float = 1.0
) -> Conformity:
    """Compare ``surface``, the interface of the generators of ``trained``, with its faces."""
    from ..mesh.spheres import near_pairs

    area, _, _ = face_frames(surface.mesh)
    owner = trained.faces_of_generators[surface.generators]
    own = owner[:, 0] == owner[:, 1]
    mesh, radii = trained.polygons, trained.radii
    corner, face = mesh.face_vertices, mesh.corner_faces
    residual = np.concatenate(
        [
            ((points[face] - mesh.vertices[corner]) ** 2).sum(axis=1) - radii[corner] ** 2
            for points in (trained.inside, trained.outside)
        ]
    )
    targets = np.concatenate([trained.outside, trained.inside])
    point, sphere = near_pairs(mesh, targets, mesh.vertices, radii, 0.0, threads)
    reach = ((targets[point] - mesh.vertices[sphere]) ** 2).sum(axis=1) - radii[sphere] ** 2
    return Conformity(
        pair_area_share=float(area[own].sum() / area.sum()),
        pair_faces=len(np.unique(owner[own, 0])),
        trained_faces=trained.face_count,
        interface_faces=surface.mesh.face_count,
        residual_max=float(np.abs(residual).max() / spacing**2),
        residual_rms=float(np.sqrt((residual**2).mean()) / spacing**2),
        intrusion=float(min(reach.min(initial=0.0), 0.0) / spacing**2),
    )
