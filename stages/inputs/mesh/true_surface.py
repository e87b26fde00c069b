"""The true surface of a mesh, in model units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats, Ints
from ...mesh.queries.projection import ClosestPoint
from ...mesh.queries.true_surface import SAMPLES
from ...mesh.queries.winding import membranes

if TYPE_CHECKING:
    from .triangle_source import TriangleSource

LEVEL = 0.5
"""Winding number from which a point is inside an open mesh."""
OTHER_SHEET = 0.15
"""In units of h0: how near an opposite sheet may be and still be told apart by its normals."""
BESIDE = 1e-3
"""In units of h0: how far from a surface point is asked which side is inside."""


class MeshSurface:
    """Of a mesh: the parts of its triangles that have the inside on one side only, and what spans
    its holes."""

    def __init__(self, source: TriangleSource, frame: ModelFrame, threads: int) -> None:
        self.source, self.frame = source, frame
        vertices, triangles = frame.model_from_input(source.vertices), source.triangles
        self._closest = ClosestPoint(vertices, triangles, OTHER_SHEET, threads)
        if source.open_edges:
            spans = self._spans()
            triangles = np.concatenate([triangles, len(vertices) + spans[1]])
            vertices = np.concatenate([vertices, spans[0]])
            self._closest = ClosestPoint(vertices, triangles, OTHER_SHEET, threads)
        points, normals = self._closest.samples, self._closest.normals[self._closest.owner]
        within = self.inside(points - BESIDE * normals)
        beyond = self.inside(points + BESIDE * normals)
        # What spans a hole is only about where the inside ends.
        spanning = self._closest.triangles[self._closest.owner, 0] >= len(source.vertices)
        within, beyond = within | spanning, beyond & ~spanning
        # What lies inside another part of the mesh bounds nothing; a part that is inside out
        # has its normals turned.
        self._closest.keep(within != beyond, beyond & ~within)
        step = max(1, len(self._closest.samples) // SAMPLES)
        self.samples = self._closest.samples[::step]
        self.normals = self._closest.sample_normals[::step]

    def _spans(self) -> tuple[Floats, Ints]:
        """Vertices and triangles of what spans the holes."""
        frame = self.frame
        vertices, triangles = membranes(
            self.source.winding,
            LEVEL,
            frame.spacing,
            lambda points: frame.input_from_model(
                self._closest.locate(frame.model_from_input(points))[0]
            ),
        )
        return frame.model_from_input(vertices), triangles

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        return self._closest(points, normals)

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        return self.source.inside(self.frame.input_from_model(points))
