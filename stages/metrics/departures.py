"""Departures: parts of the written surface that the input lacks, and parts
that the surface lacks."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..mesh.geometry import fan_triangles, sample_triangles
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.queries.parity import RayParity
from ..mesh.queries.projection import ClosestPoint
from .chamfer import nearest

if TYPE_CHECKING:
    from ..inputs.source import Source
    from ..mesh.model_frame import ModelFrame
    from ..mesh.queries.true_surface import TrueSurface

SAMPLES = 20_000
"""Number of sample points on the written surface."""
FAR, SPACINGS = 1.0, 4.0
"""Distance from which on parts differ: in units of h0, and for a point cloud in
units of its spacing."""


@dataclass(frozen=True)
class Departure:
    """Distances of samples of one surface from the other one, in units of h0."""

    p99: float
    largest: float
    far: float
    """Share of the samples whose distance exceeds ``limit``."""
    limit: float
    place: list[float]
    """The place of the largest distance, in the coordinates of the input."""

    @classmethod
    def of(cls, points: Floats, distance: Floats, limit: float, frame: ModelFrame) -> Departure:
        """Summary of ``distance (N,)`` at ``points (N, 3)``, in model units."""
        worst = int(np.argmax(distance))
        return cls(
            p99=float(np.percentile(distance, 99)),
            largest=float(distance[worst]),
            far=float((distance > limit).mean()),
            limit=limit,
            place=frame.input_from_model(points[worst]).tolist(),
        )

    def told(self, spacing: float) -> str:
        """The distances as a text. ``spacing`` is h0 in the unit of the input."""
        place = ", ".join(f"{x:.6g}" for x in self.place)
        return (
            f"further than {spacing * self.limit:.3g}, up to {spacing * self.largest:.3g} at "
            f"({place})"
        )


@dataclass(frozen=True)
class Departures:
    """Distances of the written surface from the input, and of the input
    from the written surface."""

    surface: Departure
    input: Departure
    points: bool
    """Whether the input is a point cloud."""
    enclosed: float
    """Share of the points of the cloud that lie far inside the surface."""

    def facts(self) -> dict[str, Any]:
        """Figures for the manifest."""
        return {"surface_to_input": asdict(self.surface), "input_to_surface": asdict(self.input)}

    def warnings(self, spacing: float) -> list[str]:
        said = []
        if self.surface.far:
            what = "any point" if self.points else "the input"
            why = "nothing was measured there" if self.points else "the input has nothing there"
            said.append(
                f"{100 * self.surface.far:.2g} % of the surface lies "
                f"{self.surface.told(spacing)}, from {what}: {why}, so check the surface "
                "there before you use it"
            )
        if self.enclosed > 0.5 * self.input.far:
            said.append(
                f"{100 * self.enclosed:.2g} % of the points lie inside the surface, "
                f"{self.input.told(spacing)}, from it: they are not followed, so check "
                "whether they belong to the surface"
            )
        elif self.input.far:
            said.append(
                f"{100 * self.input.far:.2g} % of the input lies {self.input.told(spacing)}, "
                "from the surface: these parts are lost; raise -n"
            )
        return said


def departures(
    written: PolygonMesh, source: Source, surface: TrueSurface, frame: ModelFrame, threads: int
) -> Departures:
    """Compare the ``written`` surface, in model units, with the ``source`` it was made from, whose
    true surface is ``surface``; with the points themselves where these are the source."""
    vertices, triangles = fan_triangles(written)[:2]
    points = sample_triangles(vertices, triangles, SAMPLES, np.random.default_rng(0))[0]
    limit, reference = FAR, surface.samples
    measured = source.measured_points()
    if measured is not None:
        limit = max(FAR, SPACINGS * measured.spacing / frame.spacing)
        reference = frame.model_from_input(measured.points[measured.kept])
        distance = nearest(points, reference, threads)
    else:
        distance = np.linalg.norm(points - surface.closest(points)[0], axis=1)
    foot, _ = ClosestPoint(vertices, triangles, 0.0, threads).locate(reference)
    back = np.linalg.norm(reference - foot, axis=1)
    enclosed = 0.0
    if measured is not None:
        far = reference[back > FAR]
        enclosed = RayParity(vertices, triangles).inside(far).sum() / len(reference)
    return Departures(
        Departure.of(points, distance, limit, frame),
        Departure.of(reference, back, FAR, frame),
        measured is not None,
        float(enclosed),
    )
