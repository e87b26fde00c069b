"""Stage fabricate: a lamp, a lattice, a solid or cells to print; STL and 3MF in millimetres.

Example:
    >>> from vorolight.stages import fabricate, pipeline
    >>> pipeline.execute(session, "fabricate", fabricate.Params(lamp=True))  # doctest: +SKIP
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from . import contract
from .contract import Context, Length, Outcome, Range, Share, Stage
from .errors import UsageError
from .memory import peak

if TYPE_CHECKING:
    from .fabrication.lamp import Request

MODES = ("lamp", "lattice", "solid", "cells")
FORMATS = ("obj", "glb")
BESIDE = 10.0
"""From the object to its lid in the 3MF, mm."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the fabricate stage."""

    lamp: bool = False
    """Tubes along the surface's edges, plates, a flat base, and a cavity for a light."""
    lattice: bool = False
    """Tubes only; this is what is made if nothing is said."""
    solid: bool = False
    """The surface as a solid, or with --wall as a shell that is open where it stands."""
    cells: bool = False
    """Tubes along the edges of the volume's cells, with a base and a cavity; or --explode."""
    height: Annotated[float, Length(), Range(10, 2000)] = 120.0
    """Height of the printed object, such as 120mm, 12cm or 4.7in."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Axis of the input that points up; auto: y for OBJ, PLY, OFF and GLB files, else z."""
    edges: Literal["surface", "volume", "both"] | None = None
    """Whose edges become tubes: the surface's, the volume's inner ones, or both (of the volume);
    default: both for --cells, else surface."""
    tube_diameter: Annotated[float, Length(), Range(0.1, 100)] | None = None
    """Diameter of the tubes; default: 0.6 of the radius of the cells' faces, but 2.5 to 8
    nozzle widths."""
    taper: Annotated[float, Range(0.1, 1)] = 1.0
    """Diameter of the tubes at the top, over that at the bottom."""
    sides: Annotated[int, Range(4, 64)] = 12
    """Sides of a tube; its radius is enlarged so that the thinnest place is as asked for."""
    fillet: bool = False
    """Round the corners where tubes meet; doubles triangles and time."""
    merge: Annotated[float, Length(), Range(0, 100)] | None = None
    """Edges shorter than this are contracted; default: the tube radius."""
    plates: Share | None = None
    """Share of the faces that become solid plates; default 0.15 in a lamp, else none. Fewer where
    less than 0.3 of the surface would stay open."""
    plate_pattern: Literal["random", "even", "height", "checker"] = "random"
    """Which faces: any, far from each other, more of them below, or by bands and sectors."""
    plate_thickness: Annotated[float, Length(), Range(0.05, 20)] = 0.8
    """Thickness of the plates."""
    light: Literal["tea-light", "puck", "e14", "e27", "usb-bulb", "largest", "none"] | None = None
    """The light: a tea light (default), a puck light, an E14 or E27 holder behind a ring, a bulb on
    a cable, the widest cylinder that fits, or none."""
    light_diameter: Annotated[float, Length(), Range(3, 500)] | None = None
    """Diameter of the light or bulb, in place of the preset's."""
    light_height: Annotated[float, Length(), Range(1, 500)] | None = None
    """Height of the light or bulb, in place of the preset's."""
    clearance: Annotated[float, Length(), Range(0, 10)] = 0.5
    """Room around the light."""
    wall: Annotated[float, Length(), Range(0.4, 20)] | None = None
    """Wall of the cup around the light (default 1.6mm); with --solid, of the shell."""
    cable: Annotated[float, Length(), Range(0, 20)] | None = None
    """Width of a channel for a cable; default: the light's."""
    base: Literal["auto", "footprint", "pedestal", "none"] = "auto"
    """The shape cut flat, with the cavity inside it; a pedestal under it that holds the light; or
    neither. auto: the first where the light fits, else the second."""
    bayonet: bool = False
    """Close the cavity with a lid that locks by a turn, a second body."""
    trim: Annotated[float, Range(0.001, 0.5)] | None = None
    """Share of the shape's height cut off for a flat base; default: 0.04 to 0.2, as the light
    needs."""
    explode: Annotated[float, Range(1, 10)] = 1.0
    """With --cells: the cells as separate bodies, this much further apart."""
    nozzle: Annotated[float, Length(), Range(0.1, 2)] = 0.4
    """Nozzle width; tubes must be two of them thick."""
    layer: Annotated[float, Length(), Range(0.02, 1)] = 0.2
    """Layer height; plates must be two of them thick."""
    bed: str = "250x250x250"
    """What the printer has room for, in mm."""
    formats: str = ""
    """Further files beside PLY, STL and 3MF: obj, glb (in metres, y up), with commas between."""
    slice: bool = False
    """Slice the STL with PrusaSlicer, which must find nothing to mend; says filament and time."""
    render: bool = False
    """Draw the lamp with its light on, by path tracing (needs Mitsuba), to fabricate.png."""

    def __post_init__(self) -> None:
        super().__post_init__()
        said = [name for name in MODES if getattr(self, name)]
        if len(said) > 1:
            raise UsageError(f"--{said[0]} and --{said[1]} exclude each other; keep one of them")
        if not re.fullmatch(r"\d+(\.\d+)?x\d+(\.\d+)?x\d+(\.\d+)?", self.bed):
            raise UsageError(f"--bed {self.bed}: must be width x depth x height, as 220x220x250")
        unknown = [name for name in self.wanted_formats if name not in FORMATS]
        if unknown:
            raise UsageError(f"--formats {unknown[0]}: must be of {', '.join(FORMATS)}")
        self._check_combinations()
        if self.layer > self.nozzle:
            raise UsageError(f"--layer {self.layer:g}: higher than the nozzle is wide; lower it")
        if self.height > self.room[2]:
            raise UsageError(
                f"--height {self.height:g}: the bed has room for {self.room[2]:g} mm; lower it, or "
                "say what your printer has with --bed"
            )
        if self.tube_diameter is not None:
            _check_diameter(self.tube_diameter, self)
        if self.plate_share > 0:
            if self.mode not in ("lamp", "cells"):
                raise UsageError("--plates: only --lamp and --cells have plates; leave it out")
            if self.plate_thickness < 2 * self.layer:
                raise UsageError(
                    f"--plate-thickness {self.plate_thickness:g}: thinner than two layers; raise it"
                )
        if self.light not in (None, "none"):
            if self.mode not in ("lamp", "cells") or self.explode > 1:
                raise UsageError("--light: only --lamp and --cells have one; leave it out")
            if self.base == "none":
                raise UsageError("--base none: holds no light; say --light none, or another --base")
        if self.light_height is not None and self.light_height > self.height:
            raise UsageError(
                f"--light-height {self.light_height:g}: higher than the object; lower it or raise "
                "--height"
            )
        if self.explode > 1 and self.mode != "cells":
            raise UsageError("--explode: only cells can be drawn apart; add --cells")

    def _check_combinations(self) -> None:
        """Options that would be ignored are refused."""
        defaults = {field.name: field.default for field in fields(self)}
        lit = self.mode in ("lamp", "cells") and self.explode == 1
        for here, why, names in (
            (
                lit and self.light != "none" and self.base != "none",
                "there is no light",
                ("bayonet", "cable", "light_diameter", "light_height"),
            ),
            (lit or self.mode == "solid", "it gets no base", ("base", "trim")),
            (lit or self.mode == "solid", "it has no wall", ("wall",)),
            (self.base != "none", "nothing is cut off without a base", ("trim",)),
            (
                self.mode != "solid" and self.explode == 1,
                "there are no tubes",
                ("tube_diameter", "taper", "fillet", "merge", "edges", "plates"),
            ),
            (self.light != "largest", "the largest is looked for", ("light_diameter",)),
        ):
            for name in names:
                if not here and getattr(self, name) != defaults[name]:
                    raise UsageError(f"--{name.replace('_', '-')}: {why}; leave it out")
        if self.light == "largest" and self.base == "pedestal":
            raise UsageError("--light largest: is looked for in the shape; take another --base")
        if 1 < self.explode < 1.01:
            raise UsageError(f"--explode {self.explode:g}: the cells would touch; at least 1.01")

    @property
    def mode(self) -> str:
        """lamp, lattice, solid or cells."""
        return next((name for name in MODES if getattr(self, name)), "lattice")

    @property
    def room(self) -> tuple[float, float, float]:
        """What the printer has room for, in mm."""
        x, y, z = map(float, self.bed.split("x"))
        return x, y, z

    @property
    def wanted_formats(self) -> list[str]:
        return [name.strip() for name in self.formats.split(",") if name.strip()]

    @property
    def plate_share(self) -> float:
        return (0.15 if self.mode == "lamp" else 0.0) if self.plates is None else self.plates

    @property
    def which_edges(self) -> str:
        """surface, volume or both."""
        return self.edges or ("both" if self.mode == "cells" else "surface")

    @property
    def needs_volume(self) -> bool:
        return self.mode != "solid" and (self.mode == "cells" or self.which_edges != "surface")


def _check_diameter(diameter: float, params: Params) -> None:
    if diameter < 2 * params.nozzle:
        raise UsageError(
            f"--tube-diameter {diameter:g}: thinner than two nozzles ({2 * params.nozzle:g} mm); "
            "raise it"
        )
    if diameter * params.taper < 2 * params.nozzle - 1e-9:
        raise UsageError(
            f"--taper {params.taper:g}: tubes of {diameter:g} mm become thinner than two nozzles "
            f"({2 * params.nozzle:g} mm); raise it or --tube-diameter"
        )
    if params.height < 4 * diameter:
        raise UsageError(
            f"--height {params.height:g}: less than four tube diameters; raise --height or lower "
            "--tube-diameter"
        )
    if params.plate_share > 0 and params.plate_thickness > diameter * params.taper + 1e-9:
        raise UsageError(
            f"--plate-thickness {params.plate_thickness:g}: thicker than the tubes "
            f"({diameter * params.taper:g} mm) that hold the plates; lower it"
        )


def run(context: Context) -> Outcome:
    """Fabrication as in the paper's appendix E.2; draws the trained polygons, not the interface.

    Of a surface of triangles the dual is drawn, a polygon around each vertex.
    """
    from .fabrication import lattice, products, slicer
    from .sources.resolve import up_axis
    from .surface.dual import dual
    from .surface.polygons import PolygonMesh

    params = context.params
    if params.slice:
        slicer.program()  # a slicer that would be missing in the end is said at once
    trained = context.arrays("sphere-train")
    polygons, surface = (
        PolygonMesh.from_arrays(trained, prefix) for prefix in ("trained/", "surface/")
    )
    triangles = bool((polygons.valences == 3).all())
    recorded = context.folder.manifest("classify") or {}
    up = params.up if params.up != "auto" else up_axis(recorded["inputs"][0]["path"])
    volume = context.arrays("volume") if params.needs_volume else None
    context.progress.start("fabricate", 4)
    shape = lattice.Shape(
        polygons=dual(polygons) if triangles else polygons,
        surface=surface,
        drawn="dual" if triangles else "trained polygons",
        volume=volume,
    )
    asked = _request(params, up)
    if params.mode == "solid":
        made = products.solid(shape, asked, params.wall)
    elif params.explode > 1:
        made = products.exploded(shape, asked, params.explode)
    else:
        design = lattice.Design(
            params.which_edges, params.tube_diameter, params.taper, params.sides, params.fillet,
            params.merge, params.plate_share, params.plate_pattern, params.plate_thickness,
            params.cable, params.nozzle, params.layer, lambda d: _check_diameter(d, params),
        )  # fmt: skip
        made = products.tubes_of(shape, asked, design, context.random("plates"), context.progress)
    return _written(context, made, Path(recorded["inputs"][0]["name"]).stem)


def _request(params: Params, up: str) -> Request:
    from .fabrication import lamp, lights

    preset = params.light or ("tea-light" if params.mode in ("lamp", "cells") else "none")
    light = lights.PRESETS.get(preset)
    if params.base == "none" or params.explode > 1:
        light = None
    if light is not None:
        if params.light_diameter is not None:
            light = replace(light, diameter=params.light_diameter)
        if params.light_height is not None:
            light = replace(light, height=params.light_height)
    flat = params.mode in ("lamp", "cells", "solid") and params.explode == 1
    base = params.base if flat else "none"
    return lamp.Request(
        up, params.height, 0.0, params.trim, base, light, preset, params.clearance,
        1.6 if params.wall is None else params.wall, params.bayonet, params.room,
    )  # fmt: skip


def _written(context: Context, made: Any, name: str) -> Outcome:
    """Files, checks and figures of a product."""
    import numpy as np

    from .export import glb, obj, ply, stl, threemf
    from .fabrication import printcheck, slicer
    from .surface.polygons import PolygonMesh

    params = context.params
    part, low = made.part, made.part.vertices.min(axis=0)
    size = tuple(float(x) for x in part.vertices.max(axis=0) - low)
    checks = made.checks(params.room, params.nozzle, params.layer)
    fit = next(check for check in checks if check.name == "bed")
    if fit.verdict == "fail":
        raise UsageError(f"--bed {params.bed}: the object is {fit.text}; lower --height")
    warnings = list(made.warnings)
    bodies = [threemf.Body(made.name, part.vertices, part.triangles)]
    files = {
        "stl": stl.encode(part.vertices, part.triangles),
        "ply": ply.encode(
            PolygonMesh.of_triangles(part.vertices.astype(np.float64), part.triangles)
        ),
    }
    if made.lid is not None:
        # Beside the object, where it can be printed: locked inside it the two would fuse.
        right = part.vertices[:, 0].max() - made.lid.vertices[:, 0].min() + np.float32(BESIDE)
        beside = made.lid.vertices + np.array([right, 0, 0], np.float32)
        bodies.append(threemf.Body("lid", beside, made.lid.triangles))
        files["lid.stl"] = stl.encode(made.lid.vertices, made.lid.triangles)
    files["3mf"] = threemf.encode(bodies, f"{name} {made.name}", "vorolight")
    if "obj" in params.wanted_formats:
        files["obj"] = obj.encode(part.vertices, part.triangles)
    if "glb" in params.wanted_formats:
        x, y, z = 1e-3 * part.vertices.astype(np.float64).T
        colours = np.full((len(part.vertices), 3), 235, np.uint8)
        files["glb"] = glb.encode(np.stack([x, z, -y], axis=1), part.triangles, colours)
    if params.render:
        from .render import lit

        context.progress.advance(3, "picture")
        scene = part.vertices, part.triangles, made.light_at
        if lit.traced():
            files["png"] = lit.png(*scene, context.threads)
        else:
            files["png"] = lit.rasterised(*scene)
            warnings.append(
                "Mitsuba is not installed (pip install 'vorolight[render]'): the picture is "
                "rasterised, and nothing in it casts shadows"
            )

    def recheck(paths: dict[str, Path]) -> dict[str, Any]:
        found = printcheck.of_files(paths, made.expected_bodies)
        if params.slice:
            found["slicer"] = slicer.slice_file(
                paths["stl"], size[2], params.layer, params.nozzle, params.room,
                made.expected_bodies,
            ).as_json()  # fmt: skip
        return found

    context.progress.advance(4)
    failed = [f"{check.name}: {check.text}" for check in checks if check.verdict == "fail"]
    warned = [f"{check.name}: {check.text}" for check in checks if check.verdict == "warn"]
    metrics = made.metrics | {
        "mode": params.mode,
        "printability": [check.as_json() for check in checks],
        "printable": not failed,
    }
    return Outcome(
        arrays=made.arrays | {"mm_from_input": made.mm_from_input},
        files=files,
        metrics=metrics,
        warnings=[*warnings, *(f"will not print: {text}" for text in failed), *warned],
        frame={
            "unit": "mm",
            "input_from_model": np.linalg.inv(made.mm_from_input).tolist(),
            "bounding_box": [low.tolist(), part.vertices.max(axis=0).tolist()],
        },
        recheck=recheck,
    )


def _memory(context: Context) -> float:
    params = context.params
    each = 52.0 * (params.sides / 12) ** 2 * (2 if params.fillet else 1)
    if params.mode == "solid":
        return peak(300.0, 500.0, 0.0, 0)
    corners = (
        context.arrays("volume")["face_vertices"]
        if params.needs_volume
        else context.arrays("sphere-train")["trained/face_vertices"]
    )
    # An edge has two faces on a surface, and about three in a volume, of which each is held once.
    return peak(400.0, 300.0, each, len(corners) / (3 if params.needs_volume else 2))


def _parents(params: Params) -> tuple[str, ...]:
    return ("classify", "sphere-train", *(["volume"] if params.needs_volume else []))


STAGE = Stage(
    name="fabricate",
    version=5,
    params=Params,
    run=run,
    parents=_parents,
    memory=_memory,
)
