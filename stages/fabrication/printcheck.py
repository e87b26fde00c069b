"""Checks of a written STL, on the file as another library reads it back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PrintCheck:
    """What the file holds."""

    watertight: bool
    consistent_winding: bool
    bodies: int
    triangles: int
    volume_mm3: float
    size_mm: tuple[float, float, float]
    lowest_mm: float

    @property
    def fault(self) -> str | None:
        """Why the file is not fit for printing, or None."""
        if not self.watertight:
            return "is not watertight"
        if not self.consistent_winding or self.volume_mm3 <= 0:
            return "has faces turned inward"
        return None if self.bodies == 1 else f"holds {self.bodies} separate bodies"

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"fault": self.fault}


def check(path: Path) -> PrintCheck:
    """Read ``path`` with trimesh, merge equal vertices as a slicer does, and measure."""
    import trimesh

    mesh = trimesh.load_mesh(path, process=True)
    size = np.ptp(mesh.vertices, axis=0)
    return PrintCheck(
        watertight=bool(mesh.is_watertight),
        consistent_winding=bool(mesh.is_winding_consistent),
        bodies=int(mesh.body_count),
        triangles=len(mesh.faces),
        volume_mm3=float(mesh.volume),
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        lowest_mm=float(mesh.vertices[:, 2].min()),
    )
