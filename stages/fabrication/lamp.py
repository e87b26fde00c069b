"""The placement of an object: its axes, its scale, how it stands, and where its light is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import UsageError
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.solids import solid_of
from . import base, lights
from .base import Place
from .lights import Cavity, Light, Room

TRIMS = (0.04, 0.06, 0.08, 0.1, 0.13, 0.16, 0.2)
"""Shares of the height that are tried as a flat cut at the bottom. The first at which
the light fits is used."""
LEAST_DIAMETER = 8.0
"""A light narrower than this, in mm, does not count."""
LEAST_WINDOW = 4.0
"""Smallest radius, in mm, of a pedestal's opening for the light."""


@dataclass(frozen=True)
class Request:
    """The placement that the user asks for. Lengths are in mm."""

    up: str
    height: float
    overhang: float
    """Height that tubes add at the top, and at the bottom if nothing is cut off: the
    largest radius of a tube."""
    trim: float | None
    """Share of the shape's height that is cut off for a flat base. None is the least
    that the light allows."""
    base: str
    """One of auto, footprint, pedestal and none."""
    light: Light | None
    preset: str
    clearance: float
    wall: float
    lid: bool
    bed: tuple[float, float, float]
    """Size of the printer's build space."""
    taper: float = 1.0
    """Radius of the tubes at the top divided by that at the bottom."""


@dataclass(frozen=True)
class Stance:
    """The placement of the object. Lengths are in mm."""

    mm_from_input: Floats
    trim: float
    lift: float
    """Height of the pedestal; 0 if there is none."""
    base: str
    cavity: Cavity | None
    place: Place | None
    room: float | None
    """Largest diameter of a light of this height that would have fitted inside the shape."""

    def apply(self, mesh: PolygonMesh) -> PolygonMesh:
        turn, shift = self.mm_from_input[:3, :3], self.mm_from_input[:3, 3]
        return mesh.with_vertices(mesh.vertices @ turn.T + shift)


def stand(polygons: PolygonMesh, surface: PolygonMesh, asked: Request) -> Stance:
    """The placement that ``_placed`` finds, if the printer has room for it.

    Raises UsageError if no light fits, naming the largest that would, and if the object is larger
    than the printer.
    """
    stance = _placed(polygons, surface, asked)
    size = np.ptp(stance.apply(polygons).vertices, axis=0)[:2] + 2 * asked.overhang
    if (np.sort(size) > np.sort(asked.bed[:2])).any():
        x, y, z = asked.bed
        raise UsageError(
            f"--bed {x:g}x{y:g}x{z:g}: the object is {size[0]:.0f} x {size[1]:.0f} mm wide; "
            "lower --height, or give the size of your printer"
        )
    return stance


def _placed(polygons: PolygonMesh, surface: PolygonMesh, asked: Request) -> Stance:
    """The placement of an object with edges along ``polygons``, and the inside of ``surface``.

    The cavity goes to the place with the most room, over all positions and shares that may be cut
    off. Differences of bodies then check exactly that its rooms lie inside the shape.
    """

    trims = TRIMS if asked.trim is None else (asked.trim,)
    if asked.base == "none" or asked.light is None:
        trim = 0.0 if asked.base == "none" else trims[0]
        kind = "footprint" if asked.base == "auto" else asked.base
        lift = base.FOOT if kind == "pedestal" else 0.0
        return Stance(_matrix(polygons, asked, trim, lift), trim, lift, kind, None, None, None)
    cavity = lights.cavity(asked.light, asked.clearance, asked.wall, asked.lid)
    widest = -np.inf
    if asked.base != "pedestal":
        for trim in trims:
            matrix = _matrix(polygons, asked, trim, 0.0)
            stance = Stance(matrix, trim, 0.0, "footprint", cavity, None, None)
            found, diameter = _inside(stance, surface, asked)
            widest = max(widest, diameter)
            if found is not None:
                return replace(found, room=diameter)
    if asked.base == "footprint" or asked.preset == "largest":
        raise UsageError(_no_room(asked, widest))
    return _on_pedestal(polygons, surface, asked, trims[0], cavity, widest)


def _on_pedestal(
    polygons: PolygonMesh, surface: PolygonMesh, asked: Request, trim: float, cavity: Cavity,
    widest: float,
) -> Stance:  # fmt: skip
    """The placement with the light in a pedestal. Its window is so small that the
    shape stands around it."""
    room = max(widest, 0.0) if np.isfinite(widest) else None
    while True:
        lift = cavity.top
        if lift > 0.5 * asked.height:
            raise UsageError(
                f"--light {asked.preset}: its pedestal would take {lift:.0f} mm of the "
                f"height of {asked.height:g} mm; raise --height, or use a smaller light"
            )
        matrix = _matrix(polygons, asked, trim, lift)
        stance = Stance(matrix, trim, lift, "pedestal", cavity, None, room)
        placed = stance.apply(surface)
        solid = solid_of(placed)
        if cavity.bulb is None:
            x, y, _ = centre_of_edges(stance.apply(polygons), lift)
            place = Place(float(x), float(y), 0.0)
        else:
            rooms = cavity.rooms(asked.overhang)[1:]
            place = base.Inside(placed).place(rooms)
            if place.slack < 0 or not base.lies_within(rooms, place, solid):
                assert asked.light is not None
                raise UsageError(_no_room(asked, asked.light.diameter + 2 * place.slack))
        free = base.clear_of(solid, lift + 0.05, place) - base.MARGIN
        if cavity.window <= free:
            return replace(stance, place=place)
        if cavity.bulb is not None or free < LEAST_WINDOW:
            raise UsageError(
                f"--base pedestal: the foot of the shape is narrower ({2 * max(free, 0):.0f} "
                "mm) than the opening for the light; cut more off with --trim, or use "
                "another --up"
            )
        cavity = replace(cavity, window=0.95 * free)


def _no_room(asked: Request, diameter: float) -> str:
    assert asked.light is not None
    most = f"the largest light of this height that fits is {diameter:.0f} mm wide"
    if diameter < LEAST_DIAMETER:
        most = "no light of this height fits there"
    ways = "--light largest, " if diameter >= LEAST_DIAMETER and asked.preset != "largest" else ""
    ways += "--base pedestal, " if asked.base != "pedestal" and asked.preset != "largest" else ""
    return (
        f"--light {asked.preset}: {asked.light.diameter:g} x {asked.light.height:g} mm with "
        f"its wall does not fit inside the shape; {most}: use {ways}a smaller light, another "
        "--up, or a larger --height"
    )


def _inside(stance: Stance, surface: PolygonMesh, asked: Request) -> tuple[Stance | None, float]:
    """The placement with the cavity inside the shape, or None, and the
    largest diameter that fits."""
    placed = stance.apply(surface)
    inside = base.Inside(placed)
    solid = solid_of(placed).trim_by_plane((0, 0, 1), 0.0)
    cavity = stance.cavity
    assert cavity is not None
    place = inside.place(cavity.rooms(asked.overhang))
    most = cavity.light.diameter + 2 * place.slack
    if asked.preset == "largest":
        if most < LEAST_DIAMETER:
            return None, most
        light = replace(cavity.light, diameter=float(np.floor(most)))
        cavity = lights.cavity(light, asked.clearance, asked.wall, asked.lid)
    elif place.slack < 0:
        return None, most
    if not base.lies_within(cavity.rooms(asked.overhang), place, solid):
        return None, most - 2 * inside.cell
    return replace(stance, cavity=cavity, place=place), most


def centre_of_edges(polygons: PolygonMesh, low: float) -> Floats:
    """The centre of mass ``(3,)`` of tubes of one thickness along all edges above ``low``."""
    from ..mesh.topology import edges

    ends = polygons.vertices[edges(polygons)]
    middle = ends.mean(axis=1)
    weight = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) * (middle[:, 2] > low)
    return np.asarray(weight @ middle / max(float(weight.sum()), 1e-300))


def _matrix(polygons: PolygonMesh, asked: Request, trim: float, lift: float) -> Floats:
    height = asked.height - lift
    return mm_from_input(
        polygons.vertices, asked.up, height, trim, asked.overhang, lift, asked.taper
    )


def mm_from_input(
    vertices: Floats, up: str, height: float, trim: float, overhang: float, lift: float = 0.0,
    taper: float = 1.0,
) -> Floats:  # fmt: skip
    """The 4 x 4 matrix that turns ``up`` to z and scales the object to its height in mm.

    ``trim`` is the share of the shape's height that is cut off for a flat base. The cut comes to z
    = ``lift``. ``overhang`` is the height that tubes add at the top, and at the bottom if nothing
    is cut off.
    """
    axis = "xyz".index(up[-1])
    sign = -1.0 if up.startswith("-") else 1.0
    turn = np.zeros((3, 3))
    turn[2, axis] = sign
    turn[0, (axis + 1) % 3] = 1.0
    turn[1, (axis + 2) % 3] = sign  # makes the matrix a rotation, not a reflection
    placed = vertices @ turn.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    free = height - overhang * (taper if trim > 0 else 1 + taper)
    scale = free / ((high[2] - low[2]) * (1 - trim))
    bottom = low[2] + trim * (high[2] - low[2])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:2, 3] = -scale * 0.5 * (low + high)[:2]
    matrix[2, 3] = -scale * bottom + lift + (0.0 if trim > 0 else overhang)
    return matrix


@dataclass(frozen=True)
class Stand:
    """Bodies that are added to the tubes for a base, and bodies that are removed."""

    add: list[Any]
    remove: list[Any]
    lid: Any | None
    widened: bool
    """Whether the foot was made wider than the shape."""
    channel_azimuth: float


def bodies(stance: Stance, surface: PolygonMesh, polygons: PolygonMesh, cable: float) -> Stand:
    """The bodies of the base. ``surface`` and ``polygons`` are in mm."""
    if stance.base == "none":
        return Stand([], [], None, False, 0.0)
    solid = solid_of(surface)
    centre = centre_of_edges(polygons, stance.lift)
    cavity, place = stance.cavity, stance.place
    widened = False
    if stance.base == "pedestal":
        section = solid.trim_by_plane((0, 0, 1), stance.lift).translate((0, 0, -stance.lift))
        corners = base.footprint(section)
        if cavity is not None and place is not None:
            disc = base.cylinder(Room(cavity.outer, 0.0, 1.0), place)
            corners = np.concatenate([corners, base.footprint(disc)])
        plinth = base.outline_over(corners, centre, base.MARGIN).extrude(stance.lift)
        add = [plinth]
        outline = base.footprint(plinth)
    else:
        slab, widened = base.foot(solid, centre)
        add = [slab]
        outline = base.footprint(slab)
    if cavity is None or place is None:
        return Stand(add, [], None, widened, 0.0)
    azimuth = base.channel_direction(outline, place)
    cup, empty = base.cup_bodies(cavity, place, azimuth)
    channel = None
    if cable:
        reach = float(np.linalg.norm(np.ptp(outline, axis=0))) + cavity.outer
        channel = base.channel(cavity, place, azimuth, reach, cable)
    remove = [empty] if channel is None else [empty, channel]
    lid = base.lid_body(cavity, place, channel, azimuth) if cavity.lid else None
    return Stand([*add, cup], remove, lid, widened, azimuth)
