"""Training of triangle faces until their surface is the interface of its own generators.

Gauss-Newton steps bring the surface to the true one while no generator may enter a sphere that is
not its own; what resists is mended in rounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..surface.creases import give_up
from ..surface.edge_table import EdgeTable, Sized
from ..surface.embedding import kept_embedded
from ..surface.operations import Gain, contract_short, delaunay_gain, flip
from ..surface.polygons import Floats, Ints
from ..surface.remesh import astray, keeping, unfold
from ..surface.sheets import part
from .descent import DAMPING, descend
from .sphere_problem import SphereProblem
from .spheres import Spheres, edge_lengths, intrusion_gain

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..contract import Progress
    from ..sources.true_surface import TrueSurface
    from ..surface.creases import Creases

LEG = 5
"""Steps between flips of edges, searches for closest points, and checkpoints."""
ROUNDS, ROUND = 24, 10
"""The most rounds of repair, and the steps of one."""
STRICT = 4.0
"""Factor to the weights of what conformity needs in the rounds of repair."""
PATIENCE = 2
"""Rounds in which only edges are contracted and flipped, before the surface is let go."""
RELEASE, LOOSEST = 0.3, 0.003
"""Factor to the shape's weight around an intruder in each later round, and the least it becomes."""
SETTLED = (0.55, 0.9)
"""Radii around an intruder are brought back to these limits, in edge lengths."""
RINGS = 3
"""Rings of vertices around an intruder's that move in a round."""
ONWARD = 1000
"""Checkpoints after each refinement are numbered from a multiple of this on."""
SHORT = 0.5
"""Edges around an intruder shorter than this are contracted, in edge lengths."""


@dataclass(frozen=True)
class Leg:
    """How many steps, and the weights of the terms; lengths are in units of the edge length."""

    iterations: int
    weights: Mapping[str, float]
    """intersection and exclusion: a pair, or a generator and a sphere, each; shape: a vertex's
    part of the surface; normal, smooth and radius: a vertex."""


def conform(
    spheres: Spheres,
    free: NDArray[np.bool_],
    history: Floats,
    surface: TrueSurface,
    creases: Creases | None,
    leg: Leg,
    stored: Mapping[str, int],
    checkpoints: Checkpoints,
    progress: Progress,
    threads: int,
) -> tuple[Spheres, Floats, int]:
    """Train ``spheres``, those that are ``free (V,)``, then repair what does not conform.

    In a round of repair short edges around the intruders are contracted, and where that does not
    help the pull to the true surface is let go by and by, until there is room for the spheres, and
    so are creases.
    Returns the spheres, the ``history (iterations, 4)`` with the losses before the repair and the
    number of rounds. Goes on from the last checkpoint if that has been ``refined`` as often as
    ``stored`` says. Raises NumericalFailure when a value is not finite.
    """
    number, begin, damping = 0, 0, DAMPING[0]
    found = checkpoints.latest()
    if found is not None and found[1]["refined"].item() == stored["refined"]:
        kept = found[1]
        spheres = Spheres.stored(kept)
        number, begin, damping = (kept[name].item() for name in ("round", "begin", "damping"))
        history, free = kept["history"], kept["free"].astype(bool)
    strict = {key: STRICT * leg.weights[key] for key in ("intersection", "exclusion")}
    while True:
        if number and begin == 0:
            intruded = spheres.intruded(threads)
            if not intruded.any() or number > ROUNDS:
                return spheres, history, number - 1
            spheres, free = _mended(spheres, intruded, surface)
            damping = DAMPING[0]
        count = ROUND if number else leg.iterations
        weights = {**leg.weights, **strict} if number else leg.weights
        progress.start(f"repair {number}" if number else "sphere-train", count)
        for first in range(begin, count, LEG):
            if first > begin:
                before = leg.iterations + ROUND * (number - 1) if number else 0
                state: dict[str, Any] = {
                    item.name: getattr(spheres, item.name) for item in fields(Spheres)
                }
                state |= {"round": number, "begin": first, "damping": damping}
                state |= {"free": free, "history": history, **stored}
                checkpoints.save(ONWARD * stored["refined"] + before + first, state.copy)
            if not number and 2 * first < count:
                gain = intrusion_gain if first else delaunay_gain
                mesh = spheres.as_mesh()
                flip(mesh, within(free, keeping(surface, gain)))
                spheres = replace(spheres, triangles=mesh.triangles)
            last = min(count, first + LEG)
            # What conformity needs gets its full weight by and by.
            ramp = [1.0 if number else min(1.0, 2 * (i + 1) / count) for i in range(first, last)]
            problem = SphereProblem(spheres, surface, creases, weights, free, threads)
            before = spheres.centres
            spheres, losses, damping = descend(problem, spheres, ramp, damping)
            centres = kept_embedded(before, spheres.centres, spheres.triangles)
            spheres = replace(spheres, centres=centres)
            if not number:
                history = np.concatenate([history, losses])
            progress.advance(last, f"loss {losses[-1].sum():.4g}")
        number, begin = number + 1, 0


def rings_around(triangles: Ints, marked: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """``marked (V,)`` grown by rings of neighbouring vertices."""
    for _ in range(rings):
        grown = marked.copy()
        grown[triangles[marked[triangles].any(axis=1)]] = True
        marked = grown
    return marked


def _mended(
    spheres: Spheres, intruded: NDArray[np.bool_], surface: TrueSurface
) -> tuple[Spheres, NDArray[np.bool_]]:
    """Spheres with better triangles, and more room around the intruders, and which vertices may
    move, ``(V,)``."""
    triangles = spheres.triangles
    wrong = intruded.copy()
    wrong[triangles[astray(spheres.as_mesh(), surface)]] = True
    near = rings_around(triangles, wrong, 1)
    age = spheres.age + near
    old, oldest = (wrong & (age > patience) for patience in (PATIENCE, 2 * PATIENCE))
    loose = rings_around(triangles, old, 1) | rings_around(triangles, oldest, 2)
    less = np.minimum(spheres.hold, np.maximum(RELEASE * spheres.hold, LOOSEST))
    mesh = replace(spheres, hold=np.where(loose, less, spheres.hold), age=age).as_mesh()
    give_up(mesh, np.flatnonzero(rings_around(triangles, oldest, 1)))
    free = rings_around(triangles, wrong, RINGS) | rings_around(triangles, old, 2 * RINGS)
    mesh.carried = np.concatenate([mesh.carried, near[:, None], free[:, None]], axis=1)
    if old.any():
        part(mesh, rings_around(triangles, old, RINGS))
    contract_short(mesh, SHORT, near)
    unfold(mesh, surface)
    near, free = (mesh.carried[:, -2:] > 0).T
    flip(mesh, within(near, keeping(surface, intrusion_gain)))
    mesh.length = np.where(near, edge_lengths(mesh.vertices, mesh.triangles), mesh.length)
    low, high = (limit * mesh.length for limit in SETTLED)
    radii = mesh.carried[:, 0]
    mesh.carried[:, 0] = np.where(near, np.clip(radii, low, high), radii)
    return Spheres.of_mesh(mesh), free


def within(where: NDArray[np.bool_], gain: Gain) -> Gain:
    """``gain`` of the edges whose two triangles lie ``where (V,)``."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        inside = where[table.ends].all(axis=1) & where[table.opposite].all(axis=1)
        return np.where(inside, gain(mesh, table), -1.0)

    return value
