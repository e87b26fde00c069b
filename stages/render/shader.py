"""A neural deferred shader (Worchel et al. 2022).

Two small networks of our own design compute a colour from position, normal and viewing direction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ..mesh.polygons import Floats

OCTAVES = 4
"""Number of frequencies at which a position is encoded."""
CODED = 3 + 6 * OCTAVES
"""Channels of an encoded position: its coordinates, and sine and cosine at each frequency."""
AT_ONCE = 200_000
"""Number of points that are coloured at a time, which bounds the memory."""


def layers(width: int, random: np.random.Generator) -> dict[str, torch.Tensor]:
    """Initial weights and biases of the two networks, float32.

    The first network turns a position into ``width`` features. The second turns these, a normal and
    a direction into RGB.
    """
    sizes = {
        "position.0": (CODED, width),
        "position.1": (width, width),
        "colour.0": (width + 6, width),
        "colour.1": (width, width),
        "colour.2": (width, 3),
    }
    found = {}
    for name, (into, out) in sizes.items():
        bound = math.sqrt(6 / into)  # He et al. 2015, for rectified linear units
        weight = random.uniform(-bound, bound, (out, into)).astype(np.float32)
        found[f"{name}.weight"] = torch.from_numpy(weight)
        found[f"{name}.bias"] = torch.zeros(out)
    return found


def coded(position: torch.Tensor) -> torch.Tensor:
    """The encoding ``(N, CODED)`` of positions ``(N, 3)`` that lie within about 1 of the origin."""
    parts = [position]
    for octave in range(OCTAVES):
        turn = (2.0**octave * math.pi) * position
        parts += [torch.sin(turn), torch.cos(turn)]
    return torch.cat(parts, dim=1)


def shade(
    weights: Mapping[str, torch.Tensor],
    position: torch.Tensor,
    normal: torch.Tensor,
    direction: torch.Tensor,
) -> torch.Tensor:
    """RGB ``(N, 3)`` from 0 to 1. Normals and ray directions are unit vectors ``(N, 3)``."""

    def layer(name: str, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    feature = torch.relu(layer("position.0", coded(position)))
    feature = layer("position.1", feature)
    x = torch.relu(layer("colour.0", torch.cat([feature, normal, direction], dim=1)))
    x = torch.relu(layer("colour.1", x))
    return torch.sigmoid(layer("colour.2", x))


class Shader:
    """A trained shader. Points are in the surface's coordinates; the network sees
    ``(x - centre) / size``."""

    def __init__(self, weights: Mapping[str, Any], centre: Floats, size: float) -> None:
        self.weights = {name: torch.as_tensor(values) for name, values in weights.items()}
        self.centre, self.size = centre, size

    def placed(self, points: Floats) -> torch.Tensor:
        """``points (N, 3)`` in the coordinates of the network."""
        return torch.from_numpy(((points - self.centre) / self.size).astype(np.float32))

    def __call__(self, points: Floats, normals: Floats, directions: Floats) -> Floats:
        """RGB ``(N, 3)`` from 0 to 1. Normals and ray directions are unit vectors ``(N, 3)``."""
        parts = []
        with torch.no_grad():
            for start in range(0, len(points), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                parts.append(
                    shade(
                        self.weights,
                        self.placed(points[part]),
                        torch.from_numpy(normals[part].astype(np.float32)),
                        torch.from_numpy(directions[part].astype(np.float32)),
                    ).numpy()
                )
        return np.concatenate(parts).astype(np.float64) if parts else np.zeros((0, 3))
