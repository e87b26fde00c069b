"""Trained triangles are divided where they are too far from the true surface, and trained again
there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints
from ..remesh.fitting import vertex_errors
from .repair import divided, graded_down
from .spheres import Spheres

if TYPE_CHECKING:
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface

MOST = 12
"""Rounds of refinement."""
SHARE = 0.8
"""Of the bound that a round aims at."""
SHORTEST, LONGEST = 0.5, 0.7
"""Limits of the factor to a length in a round."""


@dataclass(frozen=True)
class Refine:
    """What is asked for, in units of h0, and how many triangles it may take."""

    bound: float
    faces: int | None = None


def refined(
    spheres: Spheres, surface: TrueSurface, creases: Creases | None, asked: Refine
) -> tuple[Spheres, NDArray[np.bool_]] | None:
    """``spheres`` with shorter edges where triangles are further than the bound from the surface,
    and which of them are to be trained, ``(V,)``; None where there is nothing to do, or no
    triangle left to do it with."""
    _, far = vertex_errors(surface, spheres.centres, spheres.triangles)
    room = np.inf if asked.faces is None else asked.faces - len(spheres.triangles)
    over = np.flatnonzero(far > asked.bound)
    # Of more than there is room for, those that are furthest.
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
    """Lengths for the distances ``far (V,)`` of vertices ``over``, which grow with the square of
    the length, graded from there."""
    wanted = spheres.lengths.copy()
    wanted[over] *= np.clip(np.sqrt(SHARE * bound / far[over]), SHORTEST, LONGEST)
    return graded_down(spheres, wanted)


def _added(spheres: Spheres, wanted: Floats) -> float:
    """About how many triangles are added by ``wanted`` lengths ``(V,)``."""
    ratio = (spheres.lengths / wanted)[spheres.triangles].mean(axis=1)
    return float((ratio**2 - 1).sum())
