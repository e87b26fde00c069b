"""The true surface of a source in model units: closest points, samples with normals, inside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..surface.model_frame import ModelFrame
from ..surface.polygons import Floats
from .fields import FieldSource
from .mesh import MeshSource
from .projection import ClosestPoint

if TYPE_CHECKING:
    from .protocol import Source

SAMPLES = 10_000
"""Points that stand for the surface where its thickness and its tips are looked for."""
OTHER_SHEET = 0.15
"""In units of h0: how near an opposite sheet may be and still be told apart by its normals."""
BESIDE = 1e-3
"""In units of h0: how far from a surface point is asked which side is inside."""
NEWTON_STEPS, NEWTON_REACH = 4, 0.5
"""Rounds of the projection onto a field's zero set, and the longest step in units of h0."""


class TrueSurface(Protocol):
    """What generators are mirrored in and vertices are drawn to. Lengths in units of h0."""

    samples: Floats
    normals: Floats
    """Outward unit normals at ``samples``, both ``(S, 3)``."""

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """The closest surface points ``(N, 3)`` and the outward unit normals there.

        With ``normals (N, 3)`` only points whose normal does not oppose them, where there are any.
        """
        ...

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""
        ...


def true_surface(source: Source, frame: ModelFrame, threads: int) -> TrueSurface:
    """The surface of ``source``. Raises TypeError for a source that has none."""
    if isinstance(source, MeshSource):
        return MeshSurface(source, frame, threads)
    if isinstance(source, FieldSource):
        return FieldSurface(source, frame)
    raise TypeError(f"{source.kind} has no surface")


class MeshSurface:
    """Of a mesh: the parts of its triangles that have the inside on one side only."""

    def __init__(self, source: MeshSource, frame: ModelFrame, threads: int) -> None:
        self.source, self.frame = source, frame
        vertices = frame.model_from_input(source.vertices)
        self._closest = ClosestPoint(vertices, source.triangles, OTHER_SHEET, threads)
        points, normals = self._closest.samples, self._closest.normals[self._closest.owner]
        within = self.inside(points - BESIDE * normals)
        beyond = self.inside(points + BESIDE * normals)
        # What lies inside another part of the mesh bounds nothing; a part that is inside out
        # has its normals turned.
        self._closest.keep(within != beyond, beyond & ~within)
        step = max(1, len(self._closest.samples) // SAMPLES)
        self.samples = self._closest.samples[::step]
        self.normals = self._closest.sample_normals[::step]

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
        at = points.copy()
        slope = np.zeros_like(at)
        for _ in range(NEWTON_STEPS):
            for _ in range(2):
                value, slope = self.source.gradient(self.frame.input_from_model(at))
                steepness = np.linalg.norm(slope, axis=1)
                step = value / np.maximum(steepness, np.finfo(float).tiny) / self.frame.spacing
                at = at - np.clip(step, -NEWTON_REACH, NEWTON_REACH)[:, None] * _unit(slope)
            normal = _unit(slope)
            way = points - at
            along = way - np.einsum("ij,ij->i", way, normal)[:, None] * normal
            size = np.linalg.norm(along, axis=1, keepdims=True)
            at = at + along * np.minimum(1.0, NEWTON_REACH / np.maximum(size, 1e-300)) * 0.7
        value, slope = self.source.gradient(self.frame.input_from_model(at))
        steepness = np.maximum(np.linalg.norm(slope, axis=1), np.finfo(float).tiny)
        step = np.clip(value / steepness / self.frame.spacing, -NEWTON_REACH, NEWTON_REACH)
        return at - step[:, None] * _unit(slope), _unit(slope)

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        return self.source.inside(self.frame.input_from_model(points))


def _unit(vectors: Floats) -> Floats:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, np.finfo(float).tiny))
