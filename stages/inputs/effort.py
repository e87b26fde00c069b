"""What a whole run up to a certified surface will take, told before it begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..memory import peak
from ..mesh.geometry import fan_triangles, sample_triangles, triangle_normals
from ..mesh.model_frame import ModelFrame
from ..mesh.voxels import VoxelGrid
from ..remesh.length_field import LengthField, triangles_of
from .source import Source

if TYPE_CHECKING:
    from ..remesh.target_lengths import Demand

SAMPLES = 20_000
"""Points of the surface at which the thickness is measured."""
SECONDS = 13.0, 2.7e-3
"""CPU seconds of stages classify, init and sphere-train: of any shape, and for each triangle. They
are fits to runs of 110 shapes of the corpus (1,400 to 72,000 triangles) on one core."""
MEMORY = 600.0, 430.0, 8.0
"""Of stage sphere-train: MB at the least and of any shape, kB for each triangle."""
MORE = 1.1
"""Factor to the number of triangles for what close creases and repairs add."""
STEPPED = 1.5
"""Area of a surface of voxels over that of the surface that it follows."""


@dataclass(frozen=True)
class Effort:
    """Of even triangles, shorter where the shape or a gap is thin."""

    triangles: int
    """With edges no shorter than there may be."""
    demand: Demand | None
    """What the thinnest parts ask for; None where the surface is not known."""

    @property
    def cpu_seconds(self) -> float:
        return SECONDS[0] + SECONDS[1] * self.triangles

    def facts(self) -> dict[str, Any]:
        """For the manifest."""
        return {
            "triangles": self.triangles,
            "cpu_seconds": round(self.cpu_seconds, 1),
            "memory_mb": round(peak(*MEMORY, self.triangles), 1),
        }

    def refusal(self, most: int, frame: ModelFrame) -> str | None:
        """Why there are more than ``most`` triangles, and what to do; None if there are not."""
        if self.demand is None or self.demand.triangles <= most:
            return None
        return (
            f"the surface needs about {self.demand.triangles:,.0f} triangles, more than {most:,}, "
            f"because the shape or its gaps are thin: {self.demand.named(frame)}; thicken it "
            "there, or go on with --allow-poor-input and a larger --max-faces"
        )


def effort(source: Source, grid: VoxelGrid, edge: float) -> Effort:
    """Of ``source``, classified as ``grid``, with triangles of edges ``edge`` voxels long."""
    if source.open_edges or source.triangulated() is None:
        sides = sum(
            int(np.count_nonzero(np.diff(np.pad(grid.interior, 1).astype(np.int8), axis=axis)))
            for axis in range(3)
        )
        return Effort(int(triangles_of(sides / STEPPED, np.array([edge]))), None)
    # What is compiled with these is large, and nothing else in stage classify needs it.
    from ..mesh.creases import Creases
    from ..mesh.queries.thickness import thin_lengths
    from ..remesh.target_lengths import LEAST, SMALLEST, demand
    from .creases.sharp_edges import ANGLE

    frame = ModelFrame(grid.origin, grid.spacing)
    vertices, triangles, _ = fan_triangles(source.manifold())
    vertices = frame.model_from_input(vertices)
    points, owner = sample_triangles(vertices, triangles, SAMPLES, np.random.default_rng(0))
    chains = source.exact_creases(frame, ANGLE)
    creases = Creases(chains) if chains else None
    beside = SMALLEST * edge
    most = np.minimum(thin_lengths(vertices, triangles, points, owner, creases, beside), edge)
    lengths = np.minimum(LengthField(points, np.maximum(most, LEAST)).lengths, edge)
    area = float(triangle_normals(vertices, triangles)[1].sum())
    return Effort(int(MORE * triangles_of(area, lengths)), demand(area, points, lengths, most))
