"""Model units: lengths divided by the voxel edge h0, about the grid's origin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .polygons import Floats


@dataclass(frozen=True)
class ModelFrame:
    """``input = origin + spacing * model``."""

    origin: Floats
    spacing: float

    @classmethod
    def of(cls, classified: Mapping[str, Any]) -> ModelFrame:
        """The frame of the grid that the classify stage stored."""
        return cls(classified["origin"], float(classified["spacing"]))

    def model_from_input(self, points: Floats) -> Floats:
        return (points - self.origin) / self.spacing

    def input_from_model(self, points: Floats) -> Floats:
        return self.origin + self.spacing * points
