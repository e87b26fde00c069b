"""The true surface of a field, its zero set, in model units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...mesh.geometry import limited
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats
from ...mesh.queries.true_surface import SAMPLES

if TYPE_CHECKING:
    from .source import FieldSource

NEWTON_STEPS, NEWTON_REACH = 4, 0.5
"""Rounds of the projection onto a field's zero set, and the longest step in units of h0."""
SLIDE = 0.7
"""Share of the way along the zero set towards a point that is made in a round."""
AT_REST = 1e-7
"""Movement in a round below which a projection is done, in units of h0."""


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
