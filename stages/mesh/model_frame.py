"""Model units: coordinates from the grid's origin, divided by the voxel edge h0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .polygons import Floats


@dataclass(frozen=True)
class ModelFrame:
    """The map between the two coordinates: ``input = origin + spacing * model``."""

    origin: Floats
    spacing: float

    @classmethod
    def of(cls, classified: Mapping[str, Any]) -> ModelFrame:
        """The frame of the grid in ``classified``, the arrays of the classify stage."""
        return cls(classified["origin"], float(classified["spacing"]))

    def model_from_input(self, points: Floats) -> Floats:
        """``points (N, 3)`` of the input in model units."""
        return (points - self.origin) / self.spacing

    def input_from_model(self, points: Floats) -> Floats:
        """``points (N, 3)`` in model units as coordinates of the input."""
        return self.origin + self.spacing * points
