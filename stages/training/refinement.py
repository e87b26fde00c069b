"""Refinement: trained triangles too far from the true surface are divided and trained again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable
from ..mesh.polygons import Floats, Ints
from ..remesh.fitting import vertex_errors
from .repair import divided, graded_down
from .spheres import Spheres

if TYPE_CHECKING:
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface

MOST = 12
"""Largest number of rounds."""
SHARE = 0.8
"""The distance at which a round aims, as a share of the bound."""
SHORTEST, LONGEST = 0.5, 0.7
"""Smallest and largest factor by which an edge length changes in a round."""


@dataclass(frozen=True)
class Refine:
    """The largest distance that is allowed, in units of h0, and the largest number of triangles."""

    bound: float
    faces: int | None = None


def refined(
    spheres: Spheres, surface: TrueSurface, creases: Creases | None, asked: Refine
) -> tuple[Spheres, NDArray[np.bool_]] | None:
    """The spheres with shorter edges where triangles are further from the surface than the bound.

    The second value says which spheres are to be trained, ``(V,)``. Returns None if no triangle is
    too far, or if no more triangles are allowed.
    """
    _, far = vertex_errors(surface, spheres.centres, spheres.triangles)
    room = np.inf if asked.faces is None else asked.faces - len(spheres.triangles)
    over = np.flatnonzero(far > asked.bound)
    # If the number of triangles does not allow all of them, the furthest are chosen.
    over = over[np.argsort(-far[over], kind="stable")]
    low, high, tried = 0, len(over), len(over)
    wanted = spheres.lengths
    while low < high:
        lengths = _shorter(spheres, far, over[:tried], asked.bound)
        if _added(spheres, lengths) <= room:
            low, wanted = tried, lengths
        else:
            high = tried - 1
        tried = (low + high + 1) // 2
    return divided(spheres, wanted, surface, creases, room) if low else None


def _shorter(spheres: Spheres, far: Floats, over: Ints, bound: float) -> Floats:
    """Target lengths for vertices ``over`` with the distances ``far (V,)``, graded around them.

    The distance grows with the square of the edge length.
    """
    wanted = spheres.lengths.copy()
    wanted[over] *= np.clip(np.sqrt(SHARE * bound / far[over]), SHORTEST, LONGEST)
    table = EdgeTable.of(spheres.triangles)
    return graded_down(spheres.centres, table, spheres.lengths, wanted)


def _added(spheres: Spheres, wanted: Floats) -> float:
    """An estimate of the number of triangles that the ``wanted`` lengths ``(V,)`` add."""
    ratio = (spheres.lengths / wanted)[spheres.triangles].mean(axis=1)
    return float((ratio**2 - 1).sum())
