"""Trained triangles are divided where they are too far from the true surface, and trained again
there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..surface.creases import drawn_on
from ..surface.edge_table import EdgeTable
from ..surface.operations import delaunay_gain, flip, split_long
from ..surface.polygons import Floats, Ints
from ..surface.remesh import keeping, relax, unfold
from ..surface.sizing import GRADATION
from .conforming import RINGS, rings_around, within
from .fitting import fit, vertex_errors
from .spheres import FIRST_RADIUS, Spheres, edge_lengths

if TYPE_CHECKING:
    from ..sources.true_surface import TrueSurface
    from ..surface.creases import Creases

MOST = 12
"""Rounds of refinement."""
SHARE = 0.8
"""Of the bound that a round aims at."""
SHORTEST, LONGEST = 0.5, 0.7
"""Limits of the factor to a length in a round."""
PASSES, STEP = 4, 0.3
"""Rounds of dividing, flipping and fitting, and the share of the way to the middle of its triangles
that a vertex goes in each."""
DIVIDED = 1.1
"""Edges longer than this many of their wanted lengths are halved."""
CHANGED = 0.999
"""Share of its length that a vertex is below where something changes."""


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
    return _divided(spheres, wanted, surface, creases, room) if low else None


def _shorter(spheres: Spheres, far: Floats, over: Ints, bound: float) -> Floats:
    """Lengths for the distances ``far (V,)`` of vertices ``over``, which grow with the square of
    the length, graded from there."""
    wanted = spheres.lengths.copy()
    wanted[over] *= np.clip(np.sqrt(SHARE * bound / far[over]), SHORTEST, LONGEST)
    table = EdgeTable.of(spheres.triangles)
    (a, b), rise = table.ends.T, GRADATION * table.lengths(spheres.centres)
    while True:
        before = wanted.copy()
        # What has its length is no reason for others to change theirs.
        source = np.where(wanted < CHANGED * spheres.lengths, wanted, np.inf)
        np.minimum.at(wanted, a, source[b] + rise)
        np.minimum.at(wanted, b, source[a] + rise)
        if (wanted > CHANGED * before).all():
            return before


def _added(spheres: Spheres, wanted: Floats) -> float:
    """About how many triangles are added by ``wanted`` lengths ``(V,)``."""
    ratio = (spheres.lengths / wanted)[spheres.triangles].mean(axis=1)
    return float((ratio**2 - 1).sum())


def _divided(
    spheres: Spheres, wanted: Floats, surface: TrueSurface, creases: Creases | None, room: float
) -> tuple[Spheres, NDArray[np.bool_]]:
    """With ``wanted`` lengths, ``room`` more triangles at the most, and what is to be trained."""
    mesh = spheres.as_mesh()
    changed = wanted < CHANGED * spheres.lengths
    free = rings_around(spheres.triangles, changed, RINGS)
    table = EdgeTable.of(spheres.triangles)
    # Elsewhere no edge is longer than it is to be.
    longest = np.zeros(len(wanted))
    np.maximum.at(longest, table.ends, table.lengths(spheres.centres)[:, None])
    mesh.length = np.where(changed, wanted, np.maximum(longest, spheres.lengths))
    marks = np.stack([changed, free], axis=1).astype(np.float64)
    mesh.carried = np.concatenate([mesh.carried, marks], axis=1)
    for _ in range(PASSES):
        # Each adds two triangles.
        room -= 2 * split_long(mesh, DIVIDED, room // 2)
        free = mesh.carried[:, -1] > 0
        flip(mesh, within(free, keeping(surface, delaunay_gain)))
        relax(mesh, STEP, free)
        fit(mesh, surface, free)
        if creases is not None:
            drawn_on(mesh, creases)
    unfold(mesh, surface)
    changed, free = (mesh.carried[:, -2:] > 0).T
    near = rings_around(mesh.triangles, changed, 1)
    now = edge_lengths(mesh.vertices, mesh.triangles)
    mesh.length = np.where(near, now, np.minimum(mesh.length, now))
    result = Spheres.of_mesh(mesh)
    radii = np.where(near, FIRST_RADIUS * result.lengths, result.radii)
    return replace(result, radii=radii, age=np.zeros_like(radii)), free
