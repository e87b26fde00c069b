"""The lamp's base: a foot that follows the footprint, and a cup that holds the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import NumericalFailure
from ..sources.parity import RayParity
from ..surface.geometry import fan_triangles
from ..surface.polygons import Floats, PolygonMesh

FOOT = 2.4
"""Thickness of the foot in mm."""
LIP = 2.0
"""How far the cup closes in above the light, and the height it takes for that, in mm."""
CELL = 1.0
"""Grid on which room for the cavity is looked for, in mm; coarser on objects over MOST_CELLS."""
MOST_CELLS = 400
SEGMENTS = 96


@dataclass(frozen=True)
class Light:
    """The light and the room it gets, all in millimetres."""

    diameter: float
    height: float
    clearance: float
    wall: float

    @property
    def cavity_radius(self) -> float:
        return self.diameter / 2 + self.clearance

    @property
    def cavity_height(self) -> float:
        return self.height + self.clearance


@dataclass(frozen=True)
class Place:
    """Where the cavity goes."""

    x: float
    y: float
    room: float
    """Largest radius about (x, y) that stays inside the shape over the cup's height; mm."""


def find_room(surface: PolygonMesh, light: Light) -> Place:
    """The axis with the most room inside ``surface (mm, base at z = 0)`` over the cup's height.

    Without any room there: the middle of the lowest slice that has a part of the shape.
    """
    from scipy.ndimage import distance_transform_edt

    vertices, triangles, _ = fan_triangles(surface)
    rays = RayParity(vertices, triangles)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cell = max(CELL, float((high - low)[:2].max()) / MOST_CELLS)
    x = np.arange(low[0] - cell, high[0] + 2 * cell, cell)
    y = np.arange(low[1] - cell, high[1] + 2 * cell, cell)
    z = np.linspace(0.25, light.cavity_height + LIP, 13)
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    inside = rays.inside(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    room = distance_transform_edt(inside.all(axis=2)) * cell
    if room.max() > 0:
        i, j = np.unravel_index(int(room.argmax()), room.shape)
        # The grid point itself is one cell inside at the least.
        return Place(float(x[i]), float(y[j]), max(float(room[i, j]) - cell, 0.0))
    filled = np.flatnonzero(inside.any(axis=(0, 1)))
    if len(filled) == 0:
        raise NumericalFailure("the shape has no inside near its base; choose another --up")
    where = np.argwhere(inside[:, :, filled[0]]).mean(axis=0)
    return Place(float(x[0] + where[0] * cell), float(y[0] + where[1] * cell), 0.0)


def base_bodies(surface: PolygonMesh, light: Light, place: Place) -> tuple[list[Any], Any]:
    """Bodies to add (foot and cup) and the cavity to take away, in millimetres."""
    from manifold3d import Manifold, Mesh64

    vertices, triangles, _ = fan_triangles(surface)
    solid = Manifold(Mesh64(vertices, triangles.astype(np.uint64)))
    if solid.status().name != "NoError":
        raise NumericalFailure(f"the surface makes no solid for the foot ({solid.status().name})")
    foot = solid.trim_by_plane((0, 0, 1), 0.0).trim_by_plane((0, 0, -1), -FOOT)
    radius, height = light.cavity_radius, light.cavity_height
    where = (place.x, place.y, 0.0)
    outer = radius + light.wall
    cup = Manifold.cylinder(height + LIP, outer, outer, SEGMENTS).translate(where)
    cavity = Manifold.cylinder(height + 1, radius, radius, SEGMENTS).translate(
        (place.x, place.y, -1.0)
    ) + Manifold.cylinder(LIP, radius, max(radius - LIP, 0.0), SEGMENTS).translate(
        (place.x, place.y, height)
    )
    return [foot, cup], cavity


def mm_from_input(vertices: Floats, up: str, height: float, trim: float, overhang: float) -> Floats:
    """The 4 x 4 map that turns ``up`` to z and gives the printed object its height.

    ``trim`` is the share of the shape's height cut off for a flat base, which comes to z = 0;
    ``overhang`` is what tubes add on top (and below, when nothing is trimmed).
    """
    axis = "xyz".index(up[-1])
    sign = -1.0 if up.startswith("-") else 1.0
    turn = np.zeros((3, 3))
    turn[2, axis] = sign
    turn[0, (axis + 1) % 3] = 1.0
    turn[1, (axis + 2) % 3] = sign  # keeps the map a rotation
    placed = vertices @ turn.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    free = height - overhang * (1 if trim > 0 else 2)
    scale = free / ((high[2] - low[2]) * (1 - trim))
    base = low[2] + trim * (high[2] - low[2])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:2, 3] = -scale * 0.5 * (low + high)[:2]
    matrix[2, 3] = -scale * base + (0.0 if trim > 0 else overhang)
    return matrix
