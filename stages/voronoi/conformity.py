"""How much of the Voronoi interface of the trained generators is the trained surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..surface.geometry import face_frames
from ..surface.polygons import Floats, Ints, PolygonMesh
from .interface import VoronoiSurface


@dataclass(frozen=True)
class Conformity:
    """Figures of the actual diagram before any merging. Squared lengths are in units of
    spacing^2."""

    pair_area_share: float
    """Area of the faces between the two generators of one trained face, divided by the whole
    area."""
    pair_faces: int
    """Trained faces whose pair has a face in the diagram."""
    trained_faces: int
    interface_faces: int
    residual_max: float
    """Largest ``|power|`` of a generator to a sphere of its face."""
    residual_rms: float
    intrusion: float
    """Most negative power of a generator to a sphere not of its face; 0 if none is inside one."""


def conformity(
    surface: VoronoiSurface,
    pair_of_generator: Ints,
    trained: PolygonMesh,
    radii: Floats,
    inside: Floats,
    outside: Floats,
    spacing: float,
    threads: int = 1,
) -> Conformity:
    """Compare the interface ``surface`` with the ``trained`` faces and their generator pairs.

    ``inside, outside (F, 3)`` belong to trained face f; ``pair_of_generator (N,)`` says which pair
    a generator of the diagram is from; ``radii (V,)`` are the spheres' over ``trained.vertices``.
    """
    from ..surface.spheres import near_pairs

    area, _, _ = face_frames(surface.mesh)
    owner = pair_of_generator[surface.generators]
    own = owner[:, 0] == owner[:, 1]
    corner, face = trained.face_vertices, trained.corner_faces
    residual = np.concatenate(
        [
            ((points[face] - trained.vertices[corner]) ** 2).sum(axis=1) - radii[corner] ** 2
            for points in (inside, outside)
        ]
    )
    targets = np.concatenate([outside, inside])
    point, sphere = near_pairs(trained, targets, trained.vertices, radii, 0.0, threads)
    reach = ((targets[point] - trained.vertices[sphere]) ** 2).sum(axis=1) - radii[sphere] ** 2
    return Conformity(
        pair_area_share=float(area[own].sum() / area.sum()),
        pair_faces=len(np.unique(owner[own, 0])),
        trained_faces=trained.face_count,
        interface_faces=surface.mesh.face_count,
        residual_max=float(np.abs(residual).max() / spacing**2),
        residual_rms=float(np.sqrt((residual**2).mean()) / spacing**2),
        intrusion=float(min(reach.min(initial=0.0), 0.0) / spacing**2),
    )
