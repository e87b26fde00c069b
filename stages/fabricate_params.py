"""The options of stage fabricate."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import Annotated, Literal

from .engine.params import Length, Range, Share, StageParams
from .errors import UsageError

MODES = ("lamp", "lattice", "solid", "cells")
FORMATS = ("obj", "glb")
CELLS = 15
"""Number of cells of a lamp from bottom to top, if the nozzle is fine enough."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the fabricate stage."""

    lamp: bool = False
    """Tubes along the surface's edges, plates, a flat base, and a cavity for a light."""
    lattice: bool = False
    """Tubes only. This is the default object."""
    solid: bool = False
    """The surface as a solid, or with --wall as a shell that is open at the bottom."""
    cells: bool = False
    """Tubes along the edges of the volume's cells, with a base and a cavity; with --explode, the
    cells themselves."""
    height: Annotated[float, Length(), Range(10, 2000)] = 120.0
    """Height of the printed object, such as 120mm, 12cm or 4.7in."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Axis of the input that points up. auto: y for OBJ, PLY, OFF and GLB files, else z."""
    edges: Literal["surface", "volume", "both"] | None = None
    """Edges that become tubes: those of the surface, the inner ones of the volume, or both.
    Default: both for --cells, else surface."""
    tube_diameter: Annotated[float, Length(), Range(0.1, 100)] | None = None
    """Diameter of the tubes. Default: 0.6 times the radius of the cells' faces, but 2.5 to 8 nozzle
    widths."""
    cell_size: Annotated[float, Length(), Range(1, 500)] | None = None
    """Width of the cells between the tubes. Default for a lamp: a fifteenth of the height, at least
    20 nozzle widths; else the faces of the surface are the cells."""
    taper: Annotated[float, Range(0.1, 1)] = 1.0
    """Diameter of the tubes at the top divided by that at the bottom."""
    sides: Annotated[int, Range(4, 64)] = 12
    """Number of sides of a tube. Its radius is enlarged so that its thinnest place has the wanted
    diameter."""
    fillet: bool = False
    """Round the corners where tubes meet. This doubles the number of triangles and the time."""
    merge: Annotated[float, Length(), Range(0, 100)] | None = None
    """Contract edges shorter than this. Default: the radius of the tubes."""
    plates: Share | None = None
    """Share of the faces that become solid plates. Default: 0.15 for a lamp, else 0. There are
    fewer plates if less than 0.3 of the surface would stay open."""
    plate_pattern: Literal["random", "even", "height", "checker"] = "random"
    """Which faces become plates: random ones, evenly spread ones, more of them at the bottom, or a
    checkerboard."""
    plate_thickness: Annotated[float, Length(), Range(0.05, 20)] = 0.8
    """Thickness of the plates."""
    light: Literal["tea-light", "puck", "e14", "e27", "usb-bulb", "largest", "none"] | None = None
    """The light: a tea light, a puck light, an E14 or E27 holder behind a ring, a bulb on a cable,
    the widest cylinder that fits, or none. Default: tea-light."""
    light_diameter: Annotated[float, Length(), Range(3, 500)] | None = None
    """Diameter of the light or bulb. Default: that of --light."""
    light_height: Annotated[float, Length(), Range(1, 500)] | None = None
    """Height of the light or bulb. Default: that of --light."""
    clearance: Annotated[float, Length(), Range(0, 10)] = 0.5
    """Free space around the light."""
    wall: Annotated[float, Length(), Range(0.4, 20)] | None = None
    """Thickness of the cup around the light (default 1.6 mm), or of the shell with --solid."""
    cable: Annotated[float, Length(), Range(0, 20)] | None = None
    """Width of a channel for a cable. Default: that of --light."""
    base: Literal["auto", "footprint", "pedestal", "none"] = "auto"
    """footprint: the shape is cut flat, and the light is inside it. pedestal: the light is in a
    stand under the shape. none: neither. auto: footprint if the light fits, else pedestal."""
    bayonet: bool = False
    """Close the cavity with a lid that locks by a turn. The lid is a second body."""
    trim: Annotated[float, Range(0.001, 0.5)] | None = None
    """Share of the height that is cut off for a flat base. Default: 0.04 to 0.2, as much as the
    light needs."""
    explode: Annotated[float, Range(1, 10)] = 1.0
    """With --cells: make the cells separate bodies, this many times as far apart."""
    nozzle: Annotated[float, Length(), Range(0.1, 2)] = 0.4
    """Width of the nozzle. Tubes must be at least twice as thick."""
    layer: Annotated[float, Length(), Range(0.02, 1)] = 0.2
    """Height of a layer. Plates must be at least twice as thick."""
    bed: str = "250x250x250"
    """Size of the printer's build space, in mm."""
    formats: str = ""
    """Further files beside PLY, STL and 3MF, separated by commas: obj, glb (in metres, y up)."""
    slice: bool = False
    """Slice the STL with PrusaSlicer, which must find nothing to repair, and report filament and
    time."""
    render: bool = False
    """Draw the lamp with its light on to fabricate.png, by path tracing (needs Mitsuba)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        said = [name for name in MODES if getattr(self, name)]
        if len(said) > 1:
            raise UsageError(f"--{said[0]} and --{said[1]} exclude each other; keep one of them")
        if not re.fullmatch(r"\d+(\.\d+)?x\d+(\.\d+)?x\d+(\.\d+)?", self.bed):
            raise UsageError(f"--bed {self.bed}: must be width x depth x height, as 220x220x250")
        unknown = [name for name in self.wanted_formats if name not in FORMATS]
        if unknown:
            raise UsageError(f"--formats {unknown[0]}: must be one of {', '.join(FORMATS)}")
        self._check_combinations()
        if self.layer > self.nozzle:
            raise UsageError(
                f"--layer {self.layer:g}: is more than the width of the nozzle; lower it"
            )
        if self.height > self.room[2]:
            raise UsageError(
                f"--height {self.height:g}: the printer has room for {self.room[2]:g} mm "
                "only; lower it, or give the size of your printer with --bed"
            )
        if self.tube_diameter is not None:
            check_diameter(self.tube_diameter, self)
        if self.plate_share > 0:
            if self.mode not in ("lamp", "cells"):
                raise UsageError("--plates: only --lamp and --cells have plates; leave it out")
            if self.plate_thickness < 2 * self.layer:
                raise UsageError(
                    f"--plate-thickness {self.plate_thickness:g}: thinner than two layers; raise it"
                )
        if self.light not in (None, "none"):
            if self.mode not in ("lamp", "cells") or self.explode > 1:
                raise UsageError("--light: only --lamp and --cells have a light; leave it out")
            if self.base == "none":
                raise UsageError(
                    "--base none: leaves no place for a light; use --light none, or another --base"
                )
        if self.light_height is not None and self.light_height > self.height:
            raise UsageError(
                f"--light-height {self.light_height:g}: higher than the object; lower it or raise "
                "--height"
            )
        if self.explode > 1 and self.mode != "cells":
            raise UsageError("--explode: only cells can be drawn apart; add --cells")

    def _check_combinations(self) -> None:
        """Refuse options that would have no effect."""
        defaults = {field.name: field.default for field in fields(self)}
        lit = self.mode in ("lamp", "cells") and self.explode == 1
        for here, why, names in (
            (
                lit and self.light != "none" and self.base != "none",
                "the object has no light",
                ("bayonet", "cable", "light_diameter", "light_height"),
            ),
            (lit or self.mode == "solid", "the object has no base", ("base", "trim")),
            (lit or self.mode == "solid", "the object has no wall", ("wall",)),
            (self.base != "none", "nothing is cut off without a base", ("trim",)),
            (
                self.mode != "solid" and self.explode == 1,
                "the object has no tubes",
                ("tube_diameter", "taper", "fillet", "merge", "edges", "plates"),
            ),
            (
                self.mode in ("lamp", "lattice") and self.which_edges == "surface",
                "the tubes do not run along the surface",
                ("cell_size",),
            ),
            (
                self.light != "largest",
                "only --light largest finds the diameter itself",
                ("light_diameter",),
            ),
        ):
            for name in names:
                if not here and getattr(self, name) != defaults[name]:
                    raise UsageError(f"--{name.replace('_', '-')}: {why}; leave it out")
        if self.light == "largest" and self.base == "pedestal":
            raise UsageError(
                "--light largest: the light is placed inside the shape, not in a pedestal; use "
                "another --base"
            )
        if 1 < self.explode < 1.01:
            raise UsageError(
                f"--explode {self.explode:g}: the cells would touch; use at least 1.01"
            )

    @property
    def mode(self) -> str:
        """lamp, lattice, solid or cells."""
        return next((name for name in MODES if getattr(self, name)), "lattice")

    @property
    def room(self) -> tuple[float, float, float]:
        """Size of the printer's build space, in mm."""
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
    def cell_width(self) -> float | None:
        """Width of the cells on the surface in mm; None if the surface's own faces are the
        cells."""
        if self.cell_size is None and self.mode == "lamp" and self.which_edges == "surface":
            return max(self.height / CELLS, 20 * self.nozzle)
        return self.cell_size

    @property
    def needs_volume(self) -> bool:
        return self.mode != "solid" and (self.mode == "cells" or self.which_edges != "surface")


def check_diameter(diameter: float, params: Params) -> None:
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
            f"--plate-thickness {params.plate_thickness:g}: thicker than the tubes around "
            f"the plates ({diameter * params.taper:g} mm); lower it"
        )
