"""Stage fabricate: tubes along the edges, plates, a base for a light; an STL in millimetres.

Example:
    >>> from vorolight.stages import fabricate, pipeline
    >>> pipeline.execute(session, "fabricate", fabricate.Params(lamp=True))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from . import contract
from .contract import Context, Outcome, Range, Share, Stage
from .errors import UsageError
from .memory import peak


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the fabricate stage."""

    lamp: bool = False
    """Add plates, a flat base and a cavity for a light; without it, tubes only."""
    height: Annotated[float, Range(10, 2000)] = 120.0
    """Height of the printed object in mm."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Axis of the input that points up; auto: y for OBJ, PLY, OFF and GLB files, else z."""
    tube_diameter: Annotated[float, Range(0.1, 100)] | None = None
    """Diameter of the tubes in mm; default: three nozzle widths."""
    sides: Annotated[int, Range(4, 64)] = 12
    """Sides of a tube; its radius is enlarged so that the thinnest place is as asked for."""
    weld: Annotated[float, Range(0, 100)] | None = None
    """Edges shorter than this many mm are contracted; default: the tube radius."""
    plates: Share = 0.15
    """Share of the faces that become solid plates (lamp only), drawn at random."""
    plate_thickness: Annotated[float, Range(0.05, 20)] = 0.8
    """Thickness of the plates in mm."""
    led_diameter: Annotated[float, Range(3, 500)] = 38.0
    """Diameter of the light in mm; 38 x 20 is a tea light."""
    led_height: Annotated[float, Range(1, 500)] = 20.0
    """Height of the light in mm."""
    clearance: Annotated[float, Range(0, 10)] = 0.5
    """Room around the light in mm."""
    wall: Annotated[float, Range(0.4, 20)] = 1.6
    """Wall of the cup around the light in mm."""
    trim: Annotated[float, Range(0.001, 0.5)] = 0.04
    """Share of the shape's height that is cut off for a flat base (lamp only)."""
    nozzle: Annotated[float, Range(0.1, 2)] = 0.4
    """Nozzle width in mm; tubes must be two of them thick."""
    layer: Annotated[float, Range(0.02, 1)] = 0.2
    """Layer height in mm; plates must be two of them thick."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.diameter < 2 * self.nozzle:
            raise UsageError(
                f"--tube-diameter {self.diameter:g}: thinner than two nozzles "
                f"({2 * self.nozzle:g} mm); raise it"
            )
        if self.height < 4 * self.diameter:
            raise UsageError(
                f"--height {self.height:g}: less than four tube diameters; raise --height or "
                "lower --tube-diameter"
            )
        if self.lamp and self.plates > 0 and self.plate_thickness < 2 * self.layer:
            raise UsageError(
                f"--plate-thickness {self.plate_thickness:g}: thinner than two layers; raise it"
            )
        if self.lamp and self.plates > 0 and self.plate_thickness > self.diameter:
            raise UsageError(
                f"--plate-thickness {self.plate_thickness:g}: thicker than the tubes "
                f"({self.diameter:g} mm) that hold the plates; lower it"
            )
        if self.lamp and self.led_height > self.height / 2:
            raise UsageError(
                f"--led-height {self.led_height:g}: higher than half the lamp; lower it or raise "
                "--height"
            )

    @property
    def diameter(self) -> float:
        """Tube diameter in mm."""
        default = round(3 * self.nozzle, 6)
        return default if self.tube_diameter is None else self.tube_diameter


def run(context: Context) -> Outcome:
    """Fabrication as in the paper's appendix E.2; draws the trained polygons, not the interface.

    Of a surface of triangles the dual is drawn, a polygon around each vertex.
    """
    import numpy as np

    from .errors import NumericalFailure
    from .export import ply, stl
    from .fabrication import assembly, lamp, plates, tubes
    from .sources.resolve import up_axis
    from .surface.dual import dual
    from .surface.polygons import PolygonMesh

    params = context.params
    diameter = params.diameter
    trained = context.arrays("sphere-train")
    polygons, surface = (
        PolygonMesh.from_arrays(trained, prefix) for prefix in ("trained/", "surface/")
    )
    triangles = bool((polygons.valences == 3).all())
    if triangles:
        polygons = dual(polygons)
    recorded = context.folder.manifest("classify") or {}
    up = params.up if params.up != "auto" else up_axis(recorded["inputs"][0]["path"])
    trim = params.trim if params.lamp else 0.0
    matrix = lamp.mm_from_input(polygons.vertices, up, params.height, trim, diameter / 2)
    turn, shift = matrix[:3, :3], matrix[:3, 3]
    polygons = polygons.with_vertices(polygons.vertices @ turn.T + shift)
    surface = surface.with_vertices(surface.vertices @ turn.T + shift)
    weld = diameter / 2 if params.weld is None else params.weld
    graph = tubes.tube_graph(polygons, weld)
    context.progress.start("fabricate", 3)
    bodies = tubes.tubes(graph, diameter / 2, params.sides)
    context.progress.advance(1, f"{len(bodies)} tubes")
    warnings = []
    if not triangles:
        warnings.append(
            "the trained polygons are drawn: the interface of their generators has slivers"
        )
    metrics: dict[str, Any] = {
        "up": up,
        "tube_diameter_mm": diameter,
        "tubes": len(bodies),
        "drawn": "dual" if triangles else "trained polygons",
    }
    chosen = np.zeros(0, dtype=np.int64)
    cavity = None
    if params.lamp:
        chosen = plates.choose(graph.faces.face_count, params.plates, context.random("plates"))
        bodies += plates.plates(graph.faces, chosen, params.plate_thickness)
        light = lamp.Light(params.led_diameter, params.led_height, params.clearance, params.wall)
        place = lamp.find_room(surface, light)
        base, cavity = lamp.base_bodies(surface, light, place)
        bodies += base
        needed = light.cavity_radius + light.wall
        metrics["light"] = {
            "x_mm": place.x,
            "y_mm": place.y,
            "cavity_diameter_mm": 2 * light.cavity_radius,
            "cavity_height_mm": light.cavity_height,
            "room_diameter_mm": 2 * place.room,
            "cup_inside_shape": place.room >= needed,
        }
        if place.room < needed:
            warnings.append(
                f"the cup ({2 * needed:.1f} mm) does not fit inside the shape at its base "
                f"({2 * place.room:.1f} mm there) and stands out as a pedestal"
            )
    context.progress.advance(2, "union")
    part = assembly.assemble(bodies, cavity, params.lamp)
    if part.dropped_volume > 1.0:
        raise NumericalFailure(
            f"{part.dropped_parts} pieces of together {part.dropped_volume:.1f} mm3 are not "
            "connected to the object; raise --height or --tube-diameter, or lower --weld"
        )
    context.progress.advance(3)
    metrics |= {
        "plates": len(chosen),
        "edges_mean_mm": float(
            np.linalg.norm(np.diff(graph.nodes[graph.tubes], axis=1)[:, 0], axis=1).mean()
        ),
        "genus": part.genus,
        "volume_mm3": part.volume,
        "dropped_parts": part.dropped_parts,
        "dropped_volume_mm3": part.dropped_volume,
    }
    inverse = np.linalg.inv(matrix)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    return Outcome(
        arrays={
            "nodes": graph.nodes,
            "tubes": graph.tubes,
            "radii": np.full(len(graph.nodes), diameter / 2),
            "plates": graph.face_sources[chosen],
            "mm_from_input": matrix,
        },
        files={
            "stl": stl.encode(part.vertices, part.triangles),
            "ply": ply.encode(
                PolygonMesh.of_triangles(part.vertices.astype(np.float64), part.triangles)
            ),
        },
        metrics=metrics,
        warnings=warnings,
        frame={
            "unit": "mm",
            "input_from_model": inverse.tolist(),
            "bounding_box": [low.tolist(), high.tolist()],
        },
        recheck=recheck,
    )


def recheck(paths: dict[str, Path]) -> dict[str, Any]:
    """Read the written STL back. Raises NumericalFailure when it is not fit for printing."""
    from .errors import NumericalFailure
    from .fabrication import printcheck

    found = printcheck.check(paths["stl"])
    if found.fault is not None:
        raise NumericalFailure(
            f"{paths['stl'].name}: read back, the object {found.fault}; try another "
            "--tube-diameter or --weld"
        )
    return found.as_json()


def _memory(context: Context) -> float:
    tubes = len(context.arrays("sphere-train")["trained/face_vertices"]) / 2
    return peak(300.0, 250.0, 52.0 * (context.params.sides / 12) ** 2, tubes)


STAGE = Stage(
    name="fabricate",
    version=3,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "sphere-train"),
    memory=_memory,
)
