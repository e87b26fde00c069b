"""Checks of the written files, which other libraries read back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import NumericalFailure

SCALES = {"glb": 1000.0}
"""Millimetres per unit of those file formats that do not use millimetres."""


@dataclass(frozen=True)
class PrintCheck:
    """What a file contains."""

    watertight: bool
    consistent_winding: bool
    bodies: int
    triangles: int
    volume_mm3: float
    size_mm: tuple[float, float, float]
    lowest_mm: float

    def fault(self, bodies: int = 1) -> str | None:
        """The reason why a file with this number of ``bodies`` is not fit for printing, or None."""
        if not self.watertight:
            return "is not watertight"
        if not self.consistent_winding or self.volume_mm3 <= 0:
            return "has faces turned inward"
        return None if self.bodies == bodies else f"holds {self.bodies} separate bodies"

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def check(path: Path) -> PrintCheck:
    """Measure ``path`` as trimesh reads it, with equal vertices merged, as a slicer does.

    3MF is read with lib3mf in strict mode.
    """
    import trimesh

    kind = path.suffix[1:]
    if kind == "3mf":
        from ..formats import threemf

        bodies = threemf.read(path.read_bytes())
        count = np.cumsum([0, *(len(body.vertices) for body in bodies)])
        mesh = trimesh.Trimesh(
            np.concatenate([body.vertices for body in bodies]),
            np.concatenate(
                [body.triangles + start for body, start in zip(bodies, count, strict=False)]
            ),
            process=True,
        )
    else:
        mesh = trimesh.load_mesh(path, process=True)
    scale = SCALES.get(kind, 1.0)
    vertices = mesh.vertices[:, [0, 2, 1]] * [1, -1, 1] if kind == "glb" else mesh.vertices
    size = np.ptp(vertices, axis=0) * scale
    return PrintCheck(
        watertight=bool(mesh.is_watertight),
        consistent_winding=bool(mesh.is_winding_consistent),
        bodies=int(mesh.body_count),
        triangles=len(mesh.faces),
        volume_mm3=float(mesh.volume) * scale**3,
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        lowest_mm=float(vertices[:, 2].min() * scale),
    )


CLOSE = 1e-3
"""Largest relative difference of the volumes of two files of one object. GLB is in metres, so that
its coordinates are rounded differently."""


def of_files(paths: dict[str, Path], bodies: int) -> dict[str, Any]:
    """What the STL contains, if all other files contain the same.

    Raises NumericalFailure if a file is not fit for printing.
    """
    expected = {"lid.stl": 1, "3mf": bodies + ("lid.stl" in paths)}
    kinds = [kind for kind in ("stl", "3mf", "obj", "glb", "lid.stl") if kind in paths]
    found = {kind: check(paths[kind]) for kind in kinds}
    whole = found["stl"].volume_mm3
    volumes = {"lid.stl": found["lid.stl"].volume_mm3} if "lid.stl" in found else {}
    volumes["3mf"] = whole + volumes.get("lid.stl", 0.0)
    for kind, result in found.items():
        fault = result.fault(expected.get(kind, bodies))
        if fault is None and abs(result.volume_mm3 / volumes.get(kind, whole) - 1) > CLOSE:
            fault = "has another volume than the STL"
        if fault is not None:
            raise NumericalFailure(
                f"{paths[kind].name}: read back, the object {fault}; try another "
                "--tube-diameter or --merge"
            )
    return found["stl"].as_json() | {
        "fault": None,
        "files": {kind: result.as_json() for kind, result in found.items() if kind != "stl"},
    }
