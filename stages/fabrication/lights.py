"""Lights, and the room that each of them needs. Lengths are in millimetres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

LIP = 2.0
"""Length by which a cup narrows above its light."""
RING = 3.0
"""Thickness of the ring to which a lamp holder is screwed."""
HOLDER_ROOM, HOLDER_HEIGHT = 8.0, 40.0
"""Width by which a lamp holder exceeds its hole below the ring, and the
height that it needs there."""

Preset = Literal["tea-light", "puck", "e14", "e27", "usb-bulb", "largest", "none"]


@dataclass(frozen=True)
class Light:
    """A light: a cylinder that stands in a cup, or a bulb above a ring with its holder."""

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
"""The lights by name. The holes fit E14 and E27 holders with threads of 28.5 and 39.5 mm and a ring
nut. The bulbs are a golf ball and an A60."""


@dataclass(frozen=True)
class Room:
    """A cylinder about the vertical axis of the light that must lie within the object."""

    radius: float
    low: float
    high: float


@dataclass(frozen=True)
class Cavity:
    """The empty space for a light, and the walls around it. Heights are measured from the floor."""

    light: Light
    radius: float
    """Radius of the room that is open at the floor."""
    height: float
    """Height of that room, up to the ring or to the place where the cup begins to narrow."""
    wall: float
    outer: float
    """Outer radius of the cup."""
    window: float
    """Radius of the opening over the light, or of the hole in the ring."""
    bulb: Room | None
    """The free room above the ring, if there is one."""
    lid: bool

    @property
    def top(self) -> float:
        """Height of the cup, which narrows at 45 degrees above the light."""
        return self.height + (RING if self.light.hole else self.radius - self.window)

    def rooms(self, keep: float) -> list[Room]:
        """The rooms that must lie inside the object. The bulb keeps the distance
        ``keep`` from the surface."""
        cup = Room(self.outer, 0.0, self.top)
        bulb = self.bulb
        return [cup] if bulb is None else [cup, replace(bulb, radius=bulb.radius + keep)]


LID, LUG, LUG_LOW, PLAY = 4.0, 1.5, 2.0, 0.3
"""The bayonet lid: its thickness, the length of its lugs, the height at which
they begin, and its play."""


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
