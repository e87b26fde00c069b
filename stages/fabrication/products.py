"""The products: tubes with plates and a base, solids and shells, separate cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import NumericalFailure, UsageError
from ..mesh.geometry import face_frames
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.solids import solid_of
from . import assembly, base, lamp, lattice, printability
from . import solid as solids
from .assembly import Part
from .lamp import Request, Stance, Stand
from .lattice import Design, Lattice, Shape
from .printability import Check

if TYPE_CHECKING:
    from ..progress import Progress

OVERLAP = 0.5
"""Depth in mm to which a solid extends into its pedestal."""
DRAWN = {"volume": "inner edges of the volume", "both": "edges of the volume"}
MOST_DROPPED = 1.0
"""Largest volume in mm^3 that may be lost with unconnected parts."""


def _no_tubes() -> dict[str, Any]:
    index = np.zeros(0, np.int64)
    return {
        "nodes": np.zeros((0, 3)), "tubes": index.reshape(0, 2), "radii": np.zeros(0),
        "plates": index,
    }  # fmt: skip


@dataclass(frozen=True)
class Product:
    """An object in mm that can be written."""

    name: str
    part: Part
    mm_from_input: Floats
    expected_bodies: int = 1
    lid: Part | None = None
    light_at: tuple[float, float, float] | None = None
    arrays: dict[str, Any] = field(default_factory=_no_tubes)
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    measured: list[Check] = field(default_factory=list)
    """Checks that were made while the object was made, because they need more
    than the finished mesh."""

    def checks(self, room: tuple[float, float, float], nozzle: float, layer: float) -> list[Check]:
        """All checks: those of the finished mesh, and ``measured``."""
        vertices, triangles = self.part.vertices.astype(np.float64), self.part.triangles
        size = np.ptp(vertices, axis=0)
        found = [printability.bed((float(size[0]), float(size[1]), float(size[2])), room)]
        found += self.measured
        if self.expected_bodies == 1:
            found += printability.layered(vertices, triangles, layer, nozzle)
            found.append(printability.overhangs(vertices, triangles))
        return found


def _closed(body: Any, name: str, loss: str) -> Part:
    """One printable part. Raises NumericalFailure if more than MOST_DROPPED is not connected."""
    part = assembly.largest(body)
    if part.dropped_volume > MOST_DROPPED:
        raise NumericalFailure(
            f"{part.dropped_parts} pieces of {part.dropped_volume:.1f} mm3 in total are not "
            f"connected to the {name}; {loss}"
        )
    return part


def _standing(body: Any) -> tuple[Check, dict[str, Any]]:
    centre = np.asarray(_centre(body))
    found = base.balance(centre, base.footprint(body))
    return printability.stability(found), {"centre_of_mass_mm": list(found.centre)}


def _centre(body: Any) -> Floats:
    """Centre of mass of a body ``(3,)``."""
    mesh = body.to_mesh64()
    corners = np.asarray(mesh.vert_properties[:, :3])[np.asarray(mesh.tri_verts, dtype=np.int64)]
    six = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.asarray(six @ corners.sum(axis=1) / (4 * six.sum()))


def solid(shape: Shape, asked: Request, wall: float | None) -> Product:
    """The surface as a solid or, with ``wall`` in mm, as a shell that is open at the bottom."""
    stance = lamp.stand(shape.surface, shape.surface, asked)
    surface = stance.apply(shape.surface)
    checks = []
    if wall is None:
        body = solid_of(surface)
    else:
        body, distances = solids.shell(surface, wall)
        checks.append(printability.shell(distances, wall))
    if stance.base != "none":
        # The solid extends into a pedestal, because bodies that only touch do not become one body.
        body = body.trim_by_plane((0, 0, 1), max(stance.lift - OVERLAP, 0.0))
    if stance.base == "pedestal":
        body = assembly.union([body, *lamp.bodies(stance, surface, surface, 0.0).add])
    part = _closed(body, "solid", "print them one by one")
    if part.filled_volume > MOST_DROPPED:
        if wall is None:
            raise UsageError(
                f"--solid: the shape has closed cavities of {part.filled_volume:.0f} mm3, "
                "which files for printing cannot hold; use --lattice --edges both"
            )
        raise UsageError(
            f"--wall {wall:g}: the hollow would have no opening; lower it, or open the shape "
            "with --base footprint and a larger --trim"
        )
    stable, metrics = _standing(body)
    return Product(
        "shell" if wall is not None else "solid",
        part,
        stance.mm_from_input,
        measured=[*checks, stable],
        metrics=metrics | _facts(part, stance),
    )


def exploded(shape: Shape, asked: Request, factor: float) -> Product:
    """The cells of the volume as separate bodies."""
    assert shape.volume is not None
    vertices, triangles = solids.exploded(shape.volume, factor)
    matrix = lamp.mm_from_input(vertices, asked.up, asked.height, 0.0, 0.0)
    placed = assembly.snapped(vertices @ matrix[:3, :3].T + matrix[:3, 3])
    six = placed[triangles].astype(np.float64)
    volume = float(np.einsum("ij,ij->", six[:, 0], np.cross(six[:, 1], six[:, 2]))) / 6
    cells = int(np.asarray(shape.volume["face_owner"]).max()) + 1
    return Product(
        "cells",
        Part(placed, triangles, volume, 0, 0, 0.0, 0.0),
        matrix,
        expected_bodies=cells,
        metrics={"cells": cells, "explode": factor, "volume_mm3": volume},
        warnings=["the cells are separate bodies: to look at, or to print one by one"],
    )


def tubes_of(
    shape: Shape, asked: Request, design: Design, random: np.random.Generator, progress: Progress
) -> Product:
    """Tubes along edges, with plates, a base and a cavity if they are asked for.

    Raises UsageError if the tubes would close most faces, and NumericalFailure if the result is not
    one body.
    """
    # The scale sets the default diameter, and the diameter changes the scale, hence two rounds.
    mesh, _ = lattice.followed(shape, design)
    asked = replace(asked, taper=design.taper)
    first = lamp.stand(mesh, shape.surface, replace(asked, light=None))
    diameter = design.diameter
    if diameter is None:
        diameter = lattice.default_diameter(first.apply(mesh), design)
    design.check(diameter)
    overhang = lattice.enlargement(design) * diameter / 2
    stance = lamp.stand(mesh, shape.surface, replace(asked, overhang=overhang))
    cable = design.cable
    if cable is None:
        cable = asked.light.cable if asked.light is not None else 0.0
    if stance.cavity is not None and cable > stance.cavity.radius:
        raise UsageError(
            f"--cable {cable:g}: wider than half the cavity ({2 * stance.cavity.radius:g} mm) that "
            "it leads to; lower it"
        )
    lattice.refuse_thick(stance.apply(mesh), overhang, diameter, design)
    surface, polygons = stance.apply(shape.surface), stance.apply(shape.polygons)
    made = lattice.build(shape, stance, design, diameter, random, progress)
    progress.advance(2, "base")
    footing = lamp.bodies(stance, surface, polygons, cable)
    body = made.body
    for added in footing.add:
        body += added
    for taken in footing.remove:
        body -= taken
    if stance.base != "none":
        body = body.trim_by_plane((0, 0, 1), 0.0)
    part = _closed(body, "object", _how_to_join(made, design))
    lid = None if footing.lid is None else _closed(footing.lid, "lid", "lower --cable")
    checks, metrics = _measured(made, stance, design, part, _uncut(stance, diameter, cable))
    if stance.base != "none":
        stable, balance = _standing(body)
        checks.append(stable)
        metrics |= balance
    graph = made.graph
    metrics |= _facts(part, stance) | {
        "up": asked.up,
        "drawn": DRAWN.get(design.edges, shape.drawn),
        "tube_diameter_mm": diameter,
        "tubes": len(graph.tubes),
        "plates": len(made.chosen),
        "sealed_faces": graph.face_sources[made.sealed].tolist(),
        "edges_mean_mm": float(graph.lengths.mean()),
    }
    return Product(
        name="lamp" if stance.place is not None else "lattice",
        part=part,
        mm_from_input=stance.mm_from_input,
        lid=lid,
        light_at=_light_at(stance, surface),
        arrays={
            "nodes": graph.nodes,
            "tubes": graph.tubes,
            "radii": made.radii,
            "plates": graph.face_sources[made.chosen],
        },
        metrics=metrics,
        warnings=_warnings(shape, asked, design, stance, footing, made),
        measured=checks,
    )


def _how_to_join(made: Lattice, design: Design) -> str:
    if made.graph.parts > 1:
        way = "print them one by one"
        if design.edges == "surface":
            way += ", or, if one lies inside the other, join them with --edges both"
        return f"the tubes form {made.graph.parts} separate parts: {way}"
    return "raise --height or --tube-diameter, or lower --merge"


def _measured(
    made: Lattice, stance: Stance, design: Design, part: Part, clear: Callable[[Floats], Any]
) -> tuple[list[Check], dict[str, Any]]:
    """The checks of tubes and plates, and figures of the lattice.

    ``clear`` says which points are clear of everything that is cut away.
    """
    graph, panes = made.graph, made.panes
    area, _, centre = face_frames(graph.faces)
    checks = printability.wall(
        part.vertices.astype(np.float64),
        part.triangles,
        printability.axis_points(graph, clear),
        centre[panes][clear(centre[panes])],
        made.thickness,
        design.nozzle,
        design.layer,
    )
    checks += [
        printability.bridges(graph, clear),
        printability.floating(graph, clear),
        printability.sealed(centre[made.sealed], made.gaps[made.sealed], graph.faces.face_count),
    ]
    if stance.place is not None:
        checks.append(printability.openness(float(area @ made.open_area) / float(area.sum())))
    figures = {
        "edges_less_nodes_plus_parts": graph.loops,
        "closed_faces": len(panes),
        "genus": made.genus,
        "unexplained": made.touching,
    }
    return checks, {"lattice": figures}


def _warnings(
    shape: Shape, asked: Request, design: Design, stance: Stance, footing: Stand, made: Lattice
) -> list[str]:
    said = []
    if stance.base == "pedestal" and asked.base == "auto" and stance.room is not None:
        said.append(
            "the light does not fit inside the shape (a light of up to "
            f"{max(stance.room, 0):.0f} mm wide would), so it is in a pedestal"
        )
    if stance.base != "none" and asked.trim is None and stance.trim > lamp.TRIMS[0]:
        said.append(
            f"{100 * stance.trim:.0f} % of the height was cut off to make room for the light"
        )
    if footing.widened:
        said.append("the foot was made wider than the shape, which would not stand on its own")
    wanted = round(design.plates * (made.graph.faces.face_count - len(made.sealed)))
    if len(made.chosen) < wanted:
        shown = len(made.chosen)
        said.append(
            f"only {shown} of {wanted} plates are made: more would leave too little of the "
            "surface open"
        )
    if made.touching and design.edges == "surface":
        said.append(
            f"tubes touch in {abs(made.touching)} places that are not faces, since the shape "
            "is thin there"
        )
    return said


def _uncut(stance: Stance, diameter: float, cable: float) -> Callable[[Floats], Any]:
    """A function that says which points of tube axes are clear of the floor,
    the base and the cavity."""
    floor = stance.lift + diameter + (cable if stance.lift == 0 and stance.place else 0.0)
    if stance.base == "footprint" and stance.lift == 0:
        floor = max(floor, base.FOOT + diameter)

    def keep(points: Floats) -> Any:
        clear = points[:, 2] > (floor if stance.base != "none" else -np.inf)
        if stance.place is not None and stance.cavity is not None:
            away = np.hypot(points[:, 0] - stance.place.x, points[:, 1] - stance.place.y)
            for room in stance.cavity.rooms(0.0):
                near = (away < room.radius + diameter) & (points[:, 2] < room.high + diameter)
                clear &= ~near
        return clear

    return keep


def _facts(part: Part, stance: Stance) -> dict[str, Any]:
    """Figures of any product that stands on the floor."""
    found: dict[str, Any] = {
        "base": stance.base,
        "trim": stance.trim,
        "pedestal_mm": stance.lift,
        "genus": part.genus,
        "volume_mm3": part.volume,
        "dropped_parts": part.dropped_parts,
        "dropped_volume_mm3": part.dropped_volume,
    }
    if stance.place is not None and stance.cavity is not None:
        cavity = stance.cavity
        found["light"] = {
            "x_mm": stance.place.x,
            "y_mm": stance.place.y,
            "light_diameter_mm": cavity.light.diameter,
            "cavity_diameter_mm": 2 * cavity.radius,
            "cavity_height_mm": cavity.height,
            "cup_height_mm": cavity.top,
            "largest_inside_mm": stance.room,
            "proved_inside": stance.base == "footprint" or cavity.bulb is not None,
        }
    return found


def _light_at(stance: Stance, surface: PolygonMesh) -> tuple[float, float, float] | None:
    """The place ``(3,)`` of the light in pictures: above the cup, inside the shape."""
    if stance.place is None or stance.cavity is None:
        return None
    top = float(surface.vertices[:, 2].max())
    low = stance.cavity.top
    return stance.place.x, stance.place.y, low + 0.15 * (top - low)
