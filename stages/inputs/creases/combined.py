"""Exact creases of an input, and those that are rounded or under noise."""

from __future__ import annotations

import numpy as np

from ...mesh.creases import Chain, Creases
from ...mesh.polygons import Floats
from ...mesh.queries.true_surface import TrueSurface
from .rounded_edges import rounded
from .sharp_edges import SHORTEST

BESIDE, FOLLOWS = 1.0, 0.3
"""In units of h0, how near a crease is to another where it is the same, and the share of it from
which on it is."""
ACCIDENTS = 0.3
"""Length of exact creases over that of the others, up to which they are accidents."""


def combined(
    known: list[Chain], surface: TrueSurface, box: Floats, angle: float, exact: bool
) -> list[Chain]:
    """The ``known`` creases of an input, and those within ``box (2, 3)`` that are rounded or under
    noise and turn by ``angle`` degrees or more. Model units. ``exact`` tells whether the surface is
    free of noise."""
    others = rounded(surface, box, angle, exact)
    known_length, length = (sum(chain.length for chain in made) for made in (known, others))
    # The sharp edges of a noisy mesh are accidents.
    more, less = (known, others) if known_length > ACCIDENTS * length else (others, known)
    return more + [chain for chain in _elsewhere(less, more) if chain.length >= SHORTEST]


def _elsewhere(chains: list[Chain], known: list[Chain]) -> list[Chain]:
    """The ``chains`` that do not follow ``known`` ones."""
    if not known:
        return chains
    creases = Creases(known)

    def share(chain: Chain) -> float:
        points = Creases([chain]).dense
        away = np.linalg.norm(points - creases.closest(points)[0], axis=1)
        return float((away < BESIDE).mean())

    return [chain for chain in chains if share(chain) < FOLLOWS]
