"""The true surface of a source in model units: closest points, samples with normals, inside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ...inputs.field.source import FieldSource
from ...inputs.mesh.source import LEVEL, TriangleSource
from ..geometry import limited
from ..model_frame import ModelFrame
from ..polygons import Floats, Ints
from .projection import ClosestPoint
from .winding import membranes

if TYPE_CHECKING:
    from ...inputs.source import Source

SAMPLES = 10_000
"""Points that stand for the surface where its thickness and its tips are looked for."""
OTHER_SHEET = 0.15
"""In units of h0: how near an opposite sheet may be and still be told apart by its normals."""
BESIDE = 1e-3
"""In units of h0: how far from a surface point is asked which side is inside."""
NEWTON_STEPS, NEWTON_REACH = 4, 0.5
"""Rounds of the projection onto a field's zero set, and the longest step in units of h0."""
SLIDE = 0.7
"""Share of the way along the zero set towards a point that is made in a round."""
AT_REST = 1e-7
"""Movement in a round below which a projection is done, in units of h0."""


class NearSurface(Protocol):
    """What vertices are drawn to."""

    samples: Floats
    normals: Floats
    """Outward unit normals at ``samples``, both ``(S, 3)``."""

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """The closest surface points ``(N, 3)`` and the outward unit normals there.

        With ``normals (N, 3)`` only points whose normal does not oppose them, where there are any.
        """
        ...


class TrueSurface(NearSurface, Protocol):
    """What generators are mirrored in too. Lengths in units of h0."""

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""
        ...


def true_surface(source: Source, frame: ModelFrame, threads: int) -> TrueSurface:
    """The surface of ``source``. Raises TypeError for a source that has none."""
    if isinstance(source, TriangleSource):
        return MeshSurface(source, frame, threads)
    if isinstance(source, FieldSource):
        return FieldSurface(source, frame)
    raise TypeError(f"{source.kind} has no surface")


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


class FieldSurface:
    """Of an implicit field: its zero set."""

    def __init__(self, source: FieldSource, frame: ModelFrame) -> None:
        self.source, self.frame = source, frame
        found = source.surface_samples(SAMPLES, np.random.default_rng(0))
        self.samples = frame.model_from_input(found)
        _, slope = source.gradient(found)
        self.normals = _unit(slope)

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """By steps along the gradient onto the zero set and, on it, towards the point."""
        foot, outward = points.copy(), np.zeros_like(points)
        left = np.arange(len(points))
        for last in [False] * NEWTON_STEPS + [True]:
            before = at = foot[left]
            for _ in range(1 if last else 2):
                at, normal = self._nearer(at)
            outward[left] = normal
            if not last:
                way = points[left] - at
                along = way - np.einsum("ij,ij->i", way, normal)[:, None] * normal
                at = at + limited(SLIDE * along, SLIDE * NEWTON_REACH)
            foot[left] = at
            left = left[np.linalg.norm(at - before, axis=1) > AT_REST]
            if len(left) == 0:
                break
        return foot, outward

    def _nearer(self, points: Floats) -> tuple[Floats, Floats]:
        """A Newton step from ``points (N, 3)`` onto the zero set, and the unit gradients before."""
        value, slope = self.source.gradient(self.frame.input_from_model(points))
        steepness = np.maximum(np.linalg.norm(slope, axis=1), np.finfo(float).tiny)
        step = np.clip(value / steepness / self.frame.spacing, -NEWTON_REACH, NEWTON_REACH)
        normal = slope / steepness[:, None]
        return points - step[:, None] * normal, normal

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        return self.source.inside(self.frame.input_from_model(points))


def _unit(vectors: Floats) -> Floats:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, np.finfo(float).tiny))
