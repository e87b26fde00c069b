"""Distances from samples to surfaces, which have no sampling floor, and the
agreement of normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..mesh.geometry import sample_triangles, triangle_normals
from ..mesh.polygons import Floats, Ints
from ..mesh.queries.projection import ClosestPoint
from ..mesh.queries.true_surface import TrueSurface


@dataclass(frozen=True)
class Fidelity:
    """Agreement of a surface with the true one. Lengths are in the frame of the surface."""

    surface_cd2: float
    """Sum over both directions of the mean squared distance from samples to the other surface."""
    to_reference_cd2: float
    """The part of it from samples of the surface."""
    from_reference_cd2: float
    rms: float
    """The square root of half of surface_cd2."""
    p99: float
    """The 99th percentile of the distances in both directions."""
    normal_consistency: float
    """Mean cosine, over both directions, between the normals at samples and at
    their closest points."""

    def scaled(self, factor: float) -> Fidelity:
        """The same metrics in a frame in which lengths are ``factor`` times as large."""
        return replace(
            self,
            surface_cd2=factor**2 * self.surface_cd2,
            to_reference_cd2=factor**2 * self.to_reference_cd2,
            from_reference_cd2=factor**2 * self.from_reference_cd2,
            rms=factor * self.rms,
            p99=factor * self.p99,
        )


def fidelity(
    vertices: Floats,
    triangles: Ints,
    surface: TrueSurface,
    reference: tuple[Floats, Floats],
    count: int,
    random: np.random.Generator,
    threads: int = 1,
) -> Fidelity:
    """Compare a triangle surface with ``surface``, of which ``reference`` are points and normals.

    ``count`` points are sampled on the triangles. Lengths are in model units.
    """
    own = ClosestPoint(vertices, triangles, 0.0, threads)
    points, owner = sample_triangles(vertices, triangles, count, random)
    normal = triangle_normals(vertices, triangles)[0][owner]
    foot, outward = surface.closest(points)
    there = ((points - foot) ** 2).sum(axis=1)
    place, facing = own(reference[0])
    back = ((reference[0] - place) ** 2).sum(axis=1)
    forward, backward = float(there.mean()), float(back.mean())
    agreement = np.einsum("ij,ij->i", normal, outward).mean()
    agreement += np.einsum("ij,ij->i", facing, reference[1]).mean()
    return Fidelity(
        surface_cd2=forward + backward,
        to_reference_cd2=forward,
        from_reference_cd2=backward,
        rms=float(np.sqrt(0.5 * (forward + backward))),
        p99=float(np.sqrt(np.percentile(np.concatenate([there, back]), 99))),
        normal_consistency=0.5 * float(agreement),
    )
