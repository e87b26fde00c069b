"""What a whole run up to a certified surface will take, told before it begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..surface.geometry import fan_triangles, sample_triangles, triangle_normals
from ..surface.model_frame import ModelFrame
from ..surface.polygons import Floats
from ..surface.sizing import CELL, LengthField
from .mesh import TriangleSource
from .protocol import Source
from .voxels import VoxelGrid

SAMPLES = 20_000
"""Points of the surface at which the thickness is measured."""
SECONDS = 13.0, 2.7e-3
"""CPU seconds of stages classify, init and sphere-train: of any shape, and for each triangle. They
are fits to runs of 110 shapes of the corpus (1,400 to 72,000 triangles) on one core."""
MEMORY = 600.0, 430.0, 8e-3
"""MB: the least, and what there is of any shape and for each triangle."""
MORE = 1.1
"""Factor to the number of triangles for what close creases and repairs add."""
STEPPED = 1.5
"""Area of a surface of voxels over that of the surface that it follows."""


@dataclass(frozen=True)
class Effort:
    """Of even triangles, shorter where the shape or a gap is thin."""

    triangles: int
    """With edges no shorter than there may be."""
    needed: int
    """With edges as short as the thinnest parts ask for."""
    cpu_seconds: float
    memory_mb: float
    thinnest: Floats
    """Up to three places ``(K, 3)`` that ask for the shortest edges, in the input's coordinates."""
    lengths: Floats
    """Those edges ``(K,)``, in the input's units."""

    def facts(self) -> dict[str, Any]:
        """For the manifest."""
        return {
            "triangles": self.triangles,
            "cpu_seconds": round(self.cpu_seconds, 1),
            "memory_mb": round(self.memory_mb, 1),
        }

    def refusal(self, most: int) -> str | None:
        """Why there are more than ``most`` triangles, and what to do; None if there are not."""
        if self.needed <= most:
            return None
        places = "; ".join(
            f"{length:.3g} at ({', '.join(f'{x:.6g}' for x in at)})"
            for length, at in zip(self.lengths, self.thinnest, strict=True)
        )
        return (
            f"the surface needs about {self.needed:,} triangles, more than {most:,}, because "
            f"the shape or its gaps are thin: edges of {places}; thicken it there, or go on with "
            "--allow-poor-input and a larger --max-faces"
        )


def effort(source: Source, grid: VoxelGrid, edge: float) -> Effort:
    """Of ``source``, classified as ``grid``, with triangles of edges ``edge`` voxels long."""
    frame = ModelFrame(grid.origin, grid.spacing)
    none = np.zeros((0, 3)), np.zeros(0)
    if isinstance(source, TriangleSource) and source.open_edges == 0:
        # What is compiled with these is large, and nothing else in stage classify needs it.
        from ..surface.creases import Creases
        from ..surface.spacing import LEAST, SMALLEST, distinct
        from ..surface.thickness import thin_lengths
        from .creases import ANGLE, exact

        vertices, triangles, _ = fan_triangles(source.manifold())
        vertices = frame.model_from_input(vertices)
        points, owner = sample_triangles(vertices, triangles, SAMPLES, np.random.default_rng(0))
        chains = exact(source, frame, ANGLE)
        creases = Creases(chains) if chains else None
        beside = SMALLEST * edge
        most = np.minimum(thin_lengths(vertices, triangles, points, owner, creases, beside), edge)
        lengths = np.minimum(LengthField(points, np.maximum(most, LEAST)).lengths, edge)
        # What is thinner than the least length allows asks for shorter edges all the same.
        wanted = np.minimum(lengths, np.maximum(most, 0.25 * LEAST))
        area = MORE * float(triangle_normals(vertices, triangles)[1].sum()) / CELL
        count, needed = (area * float((1 / edges**2).mean()) for edges in (lengths, wanted))
        worst = distinct(points, most, np.ones(len(points), dtype=bool))
        none = frame.input_from_model(points[worst]), frame.spacing * most[worst]
    else:
        sides = sum(
            int(np.count_nonzero(np.diff(np.pad(grid.interior, 1).astype(np.int8), axis=axis)))
            for axis in range(3)
        )
        count = needed = sides / STEPPED / (CELL * edge**2)
    return Effort(
        int(count),
        int(needed),
        SECONDS[0] + SECONDS[1] * count,
        max(MEMORY[0], MEMORY[1] + MEMORY[2] * count),
        *none,
    )
