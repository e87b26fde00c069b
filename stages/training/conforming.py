"""Training of triangles until their surface is the interface of its own generators.

Gauss-Newton steps move the surface to the true surface, while generators are kept out of the
spheres of other faces. Places where that fails are repaired in rounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from ..remesh.embedding import kept_embedded
from ..remesh.operations import delaunay_gain, flip
from ..remesh.remeshing import keeping
from ..solvers.gauss_newton import descend, first_damping
from .repair import mended, within
from .sphere_problem import SphereProblem
from .spheres import Spheres, intrusion_gain

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface
    from ..progress import Progress

LEG = 5
"""Number of steps between checkpoints. Edges are flipped and closest points found as often."""
ROUNDS, ROUND = 24, 10
"""Largest number of rounds of repair, and the number of steps in each."""
STRICT = 4.0
"""Factor by which the weights of intersection and exclusion are larger during the repair."""
ONWARD = 1000
"""Checkpoints after each refinement are numbered from the next multiple of this."""


@dataclass(frozen=True)
class Leg:
    """Number of steps, and weights of the terms. Lengths are in units of the edge length."""

    iterations: int
    weights: Mapping[str, float]
    """The weights by term: intersection for each pair, exclusion for each generator and sphere,
    shape for each vertex's part of the surface, and normal, smooth and radius for each vertex."""


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
    """Train the ``spheres`` that are ``free (V,)``, then repair where they do not conform.

    Returns the spheres, the ``history (iterations, 4)`` with the losses before the repair, and the
    number of rounds. Continues from the last checkpoint if its number of refinements is the one in
    ``stored``. Raises NumericalFailure if a value is not finite.
    """
    number, begin, damping = 0, 0, first_damping(len(spheres.centres))
    found = checkpoints.latest()
    if found is not None and found[1]["refined"].item() == stored["refined"]:
        kept = found[1]
        spheres = Spheres.stored(kept)
        number, begin = (kept[name].item() for name in ("round", "begin"))
        damping, history, free = kept["damping"], kept["history"], kept["free"].astype(bool)
    strict = {key: STRICT * leg.weights[key] for key in ("intersection", "exclusion")}
    while True:
        if number and begin == 0:
            intruded = spheres.intruded(threads)
            if not intruded.any() or number > ROUNDS:
                return spheres, history, number - 1
            spheres, free = mended(spheres, intruded, surface)
            damping = first_damping(len(spheres.centres))
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
            # Intersection and exclusion get their full weight after half of the steps.
            ramp = [1.0 if number else min(1.0, 2 * (i + 1) / count) for i in range(first, last)]
            # In a repair few spheres move, and the losses are not recorded.
            problem = SphereProblem(
                spheres, surface, creases, weights, free, threads, local=number > 0
            )
            at, start = problem.vertices, spheres.centres
            part, losses, damping[at] = descend(problem, problem.start, ramp, damping[at])
            spheres = spheres.with_part(at, part)
            centres = kept_embedded(start, spheres.centres, spheres.triangles)
            spheres = replace(spheres, centres=centres)
            if not number:
                history = np.concatenate([history, losses])
            progress.advance(last, f"loss {losses[-1].sum():.4g}")
        number, begin = number + 1, 0
