"""The place of a lamp's light, and the base on which the lamp stands.

Lengths are in millimetres; the floor is at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mesh.geometry import fan_triangles
from ..mesh.polygons import Floats, PolygonMesh
from . import layers, lights
from .lights import Cavity, Room

FOOT = 2.4
"""Thickness of the foot in mm."""
MARGIN = 3.0
"""Distance by which a pedestal extends beyond the shape, in mm."""
TILT = 8.0
"""Smallest angle in degrees to which the lamp may be tilted before it falls."""
CELL = 1.0
"""Edge in mm of the grid cells on which a place for the cavity is searched. It is larger if the
object has more than MOST_CELLS along a side."""
MOST_CELLS = 400
SLICES = 16
SEGMENTS = 96
OUTSIDE = 1e-9
"""Share of a room's volume that may lie outside because of rounding."""


@dataclass(frozen=True)
class Place:
    """A place for the axis of the cavity."""

    x: float
    y: float
    slack: float
    """Length by which the radius of all rooms could grow while they stay inside the shape;
    negative if they do not fit."""


class Inside:
    """The inside of a surface on horizontal slices. It is computed once for several searches."""

    def __init__(self, surface: PolygonMesh) -> None:
        self._vertices, self._triangles, _ = fan_triangles(surface)
        size = np.ptp(self._vertices, axis=0)
        self.cell = max(CELL, float(size[:2].max()) / MOST_CELLS)

    def distances(self, low: float, high: float) -> tuple[Floats, Floats]:
        """The distance ``(X, Y)`` of each grid cell from the outside, and the grid's origin.

        It is the smallest one over all slices from ``low`` to ``high``.
        """
        from scipy.ndimage import distance_transform_edt

        z = np.linspace(low, high, SLICES)
        z[0] += 1e-3 * (high - low)  # beside the plane in which the shape was cut flat
        found = list(layers.sections(self._vertices, self._triangles, z, self.cell))
        inside = np.logical_and.reduce([mask for _, mask, _ in found])
        # Distances are to the centre of an outside cell, one cell beyond the last inside one.
        return np.asarray(distance_transform_edt(inside) * self.cell - self.cell), found[0][2]

    def place(self, rooms: list[Room]) -> Place:
        """The axis about which ``rooms`` have the most slack."""
        found = [self.distances(room.low, room.high) for room in rooms]
        slack = np.minimum.reduce(
            [distance - room.radius for (distance, _), room in zip(found, rooms, strict=True)]
        )
        i, j = np.unravel_index(int(slack.argmax()), slack.shape)
        x, y = found[0][1] + self.cell * (np.array([i, j]) + 0.5)
        return Place(float(x), float(y), float(slack[i, j]))


def cylinder(room: Room, place: Place) -> Any:
    """A body that contains the whole cylinder, since its facets touch the cylinder from outside."""
    from manifold3d import Manifold

    radius = room.radius / np.cos(np.pi / SEGMENTS)
    body = Manifold.cylinder(room.high - room.low, radius, radius, SEGMENTS)
    return body.translate((place.x, place.y, room.low))


def lies_within(rooms: list[Room], place: Place, solid: Any) -> bool:
    """Whether no part of the rooms lies outside ``solid``, by an exact difference of bodies."""
    bodies = [cylinder(room, place) for room in rooms]
    return all((body - solid).volume() <= OUTSIDE * body.volume() for body in bodies)


def _nearest(outline: Floats, place: Place) -> Floats:
    """The vector from the axis to the nearest point of the closed line ``outline (N, 2)``."""
    offset = np.asarray(outline) - [place.x, place.y]
    along = np.roll(offset, -1, axis=0) - offset
    length = np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
    share = np.clip(-np.einsum("ij,ij->i", offset, along) / length, 0, 1)
    nearest = offset + share[:, None] * along
    return np.asarray(nearest[np.einsum("ij,ij->i", nearest, nearest).argmin()])


def channel_direction(outline: Floats, place: Place) -> float:
    """Azimuth, in radians, of the shortest line from the axis to ``outline (N, 2)``."""
    x, y = _nearest(outline, place)
    return float(np.arctan2(y, x))


def clear_of(solid: Any, height: float, place: Place) -> float:
    """The distance from the axis to the nearest side of ``solid`` at ``height``;
    infinite if there is none."""
    outlines = [np.asarray(outline) for outline in solid.slice(height).to_polygons()]
    return min((float(np.linalg.norm(_nearest(o, place))) for o in outlines), default=np.inf)


def channel(cavity: Cavity, place: Place, azimuth: float, reach: float, width: float) -> Any:
    """The channel for a cable: a box along the floor from the axis outward."""
    from manifold3d import Manifold

    box = Manifold.cube((reach, width, width + 1.0)).translate((0.0, -0.5 * width, -1.0))
    return box.rotate((0, 0, float(np.degrees(azimuth)))).translate((place.x, place.y, 0.0))


def cup_bodies(cavity: Cavity, place: Place, azimuth: float) -> tuple[Any, Any]:
    """The cup to add and the cavity to remove. With a lid, the cavity has slots for its lugs.

    ``azimuth`` is the direction of the cable, in radians. The lugs are across it.
    """
    from manifold3d import Manifold

    def tube(radius: float, low: float, high: float, top: float | None = None) -> Any:
        body = Manifold.cylinder(high - low, radius, radius if top is None else top, SEGMENTS)
        return body.translate((0.0, 0.0, low))

    cup = tube(cavity.outer, 0.0, cavity.top)
    light = cavity.light
    empty = tube(cavity.radius, -1.0, cavity.height)
    if light.hole:
        empty += tube(cavity.window, cavity.height - 1.0, cavity.top + 1.0)
    else:
        empty += tube(cavity.radius, cavity.height, cavity.top, cavity.window)
        empty += tube(cavity.window, cavity.top - 1e-3, cavity.top + 1.0)
    if cavity.bulb is not None:
        empty += tube(cavity.bulb.radius, cavity.bulb.low, cavity.bulb.high)
    if cavity.lid:
        empty += _slots(cavity).rotate((0, 0, float(np.degrees(azimuth))))
    where = (place.x, place.y, 0.0)
    return cup.translate(where), empty.translate(where)


LUG_SPAN, RUN = 24.0, 40.0
"""Angle of a lug, and the angle by which the lid is turned to lock it, in degrees."""


def _sector(inner: float, outer: float, start: float, stop: float, low: float, high: float) -> Any:
    """Part of a ring between two azimuths in degrees."""
    from manifold3d import CrossSection

    angles = np.radians(np.linspace(start, stop, max(2, round((stop - start) / 3) + 1)))
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = np.concatenate([outer * arc, inner * arc[::-1]])
    return CrossSection([ring]).extrude(high - low).translate((0.0, 0.0, low))


def _slots(cavity: Cavity) -> Any:
    """Two slots in the wall, which lead up from the floor, then sideways.

    Angles are measured from the middle of a locked lug.
    """
    inner, outer = cavity.radius - 1.0, cavity.radius + lights.LUG + lights.PLAY
    top = lights.LID + lights.PLAY
    half = 0.5 * LUG_SPAN + 2.0
    body = None
    for turn in (90.0, 270.0):
        entry = _sector(inner, outer, turn + RUN - half, turn + RUN + half, -1.0, top)
        run = _sector(
            inner, outer, turn - half, turn + RUN + half, lights.LUG_LOW - lights.PLAY, top
        )
        body = entry + run if body is None else body + entry + run
    return body


def lid_body(cavity: Cavity, place: Place, cable: Any | None, azimuth: float) -> Any:
    """The lid in its locked position: a disc with two lugs, and a groove for turning it."""
    from manifold3d import Manifold

    radius = cavity.radius - lights.PLAY
    body = Manifold.cylinder(lights.LID, radius, radius, SEGMENTS)
    for turn in (90.0, 270.0):
        body += _sector(
            0.5 * radius, cavity.radius + lights.LUG, turn - 0.5 * LUG_SPAN, turn + 0.5 * LUG_SPAN,
            lights.LUG_LOW, lights.LID,
        )  # fmt: skip
    groove = Manifold.cube((1.2 * radius, 3.0, 1.5)).translate((-0.6 * radius, -1.5, 0.0))
    body = (body - groove).rotate((0, 0, float(np.degrees(azimuth))))
    body = body.translate((place.x, place.y, 0.0))
    return body if cable is None else body - cable


@dataclass(frozen=True)
class Balance:
    """How stably a body stands: its centre of mass, and how far it can be tilted."""

    centre: tuple[float, float, float]
    tilt_degrees: float
    """The angle to which the body can be tilted before it falls; negative if it falls by itself."""


def balance(centre: Floats, footprint: Floats) -> Balance:
    """The balance of a body with this ``centre (3,)`` of mass.

    ``footprint (N, 2)`` is the convex hull of the parts that touch the floor, counterclockwise.
    """
    if len(footprint) < 3:
        return Balance((float(centre[0]), float(centre[1]), float(centre[2])), -90.0)
    along = np.roll(footprint, -1, axis=0) - footprint
    length = np.linalg.norm(along, axis=1)
    whole = length > 1e-9
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)[whole] / length[whole, None]
    margin = float(np.einsum("ij,ij->i", centre[:2] - footprint[whole], inward).min())
    tilt = float(np.degrees(np.arctan2(margin, max(float(centre[2]), 1e-9))))
    return Balance((float(centre[0]), float(centre[1]), float(centre[2])), tilt)


def footprint(body: Any) -> Floats:
    """The convex hull of the parts of ``body`` that touch the floor,
    ``(N, 2)``, counterclockwise."""
    hull = body.slice(0.05).hull()
    polygons = hull.to_polygons()
    return np.asarray(polygons[0], dtype=np.float64) if len(polygons) else np.zeros((0, 2))


def foot(solid: Any, centre: Floats) -> tuple[Any, bool]:
    """The lowest slab of the shape, and whether it was widened.

    It is widened if it would not support ``centre``, the centre of mass.
    """
    slab = solid.trim_by_plane((0, 0, 1), 0.0).trim_by_plane((0, 0, -1), -FOOT)
    outline = footprint(slab)
    if balance(centre, outline).tilt_degrees >= TILT:
        return slab, False
    return slab + outline_over(outline, centre, 0.0).extrude(FOOT), True


def outline_over(footprint: Floats, centre: Floats, margin: float) -> Any:
    """A convex outline over ``footprint`` on which the lamp can be tilted by more than TILT."""
    from manifold3d import CrossSection

    reserve = 1.1 * float(np.tan(np.radians(TILT))) * float(centre[2]) + 1.0
    disc = CrossSection.circle(reserve, SEGMENTS).translate((float(centre[0]), float(centre[1])))
    corners = np.concatenate([*disc.to_polygons(), footprint])
    hull = CrossSection.hull_points(corners)
    return hull.offset(margin) if margin else hull
