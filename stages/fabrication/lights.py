"""Lights, and the room that each of them needs. In millimetres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

LIP = 2.0
"""How far a cup narrows above its light."""
RING = 3.0
"""Thickness of the ring that a lamp holder is screwed to."""
HOLDER_ROOM, HOLDER_HEIGHT = 8.0, 40.0
"""How much wider than its hole a lamp holder is below the ring, and the height that it needs
there."""

Preset = Literal["tea-light", "puck", "e14", "e27", "usb-bulb", "largest", "none"]


@dataclass(frozen=True)
class Light:
    """A light: a cylinder that stands in a cup, or a bulb above a ring that carries its holder."""

    diameter: float
    height: float
    hole: float = 0.0
    """Diameter of the hole for the lamp holder in the ring; 0 for a light without a holder."""
    cable: float = 0.0
    """Width of the channel for the cable."""


PRESETS = {
    "tea-light": Light(38.0, 20.0),
    "puck": Light(68.0, 27.0),
    "e14": Light(45.0, 80.0, hole=29.0, cable=6.0),
    "e27": Light(60.0, 110.0, hole=40.0, cable=6.0),
    "usb-bulb": Light(45.0, 75.0, hole=32.0, cable=5.0),
    "largest": Light(0.0, 20.0),
}
"""Clearance for E14 and E27 holders: 28.5 and 39.5 mm threads with a ring nut. Bulbs: golf ball,
A60."""


@dataclass(frozen=True)
class Room:
    """A cylinder about the vertical axis of the light that must lie within the object."""

    radius: float
    low: float
    high: float


@dataclass(frozen=True)
class Cavity:
    """The empty space for a light, and what is built around it. Heights count from the floor."""

    light: Light
    radius: float
    """Radius of the room that opens at the floor."""
    height: float
    """Height of that room, up to the ring or to where the cup begins to narrow."""
    wall: float
    outer: float
    """Radius of the cup's outside."""
    window: float
    """Radius of the opening over the light, or of the ring's hole."""
    bulb: Room | None
    """Free room over the ring."""
    lid: bool

    @property
    def top(self) -> float:
        """Height of the cup, which narrows at 45 degrees above the light."""
        return self.height + (RING if self.light.hole else self.radius - self.window)

    def rooms(self, keep: float) -> list[Room]:
        """Rooms that must lie within the object; the bulb keeps a distance ``keep`` from the
        surface."""
        cup = Room(self.outer, 0.0, self.top)
        bulb = self.bulb
        return [cup] if bulb is None else [cup, replace(bulb, radius=bulb.radius + keep)]


LID, LUG, LUG_LOW, PLAY = 4.0, 1.5, 2.0, 0.3
"""The bayonet lid: thickness, reach of its lugs, the height at which they begin, and its play."""


def cavity(light: Light, clearance: float, wall: float, lid: bool) -> Cavity:
    """The cavity for ``light`` with ``clearance`` around it and walls of ``wall``."""
    floor = LID if lid else 0.0
    bulb = None
    if light.hole:
        radius = 0.5 * (light.hole + HOLDER_ROOM) + clearance
        height = floor + HOLDER_HEIGHT
        low = height + RING
        bulb = Room(0.5 * light.diameter + clearance, low, low + light.height + clearance)
    else:
        radius = 0.5 * light.diameter + clearance
        height = floor + light.height + clearance
    outer = radius + (LUG + PLAY if lid else 0.0) + wall
    window = 0.5 * light.hole or max(radius - LIP, 0.25 * radius)
    return Cavity(light, radius, height, wall, outer, window, bulb, lid)
