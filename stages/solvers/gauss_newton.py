"""The loop of damped Gauss-Newton steps for a problem that gives residuals and derivatives.

The damping differs from place to place. A place is a group of unknowns, such as a triangle, at
which a step can be shortened on its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.polygons import Floats
from .least_squares import Block, GaussNewton

DAMPING = 1e-2, 1e-4, 1e2
"""The first, the smallest and the largest damping."""
EASIER, HARDER = 3.0, 5.0
"""Damping is divided by the first number where a step was taken whole, and multiplied by
the second elsewhere."""
TRIALS, SHORTER = 5, 0.3
"""Number of times that a step is tried, and the factor by which it is shortened where residuals
grow. The last shortening is to 0."""
WORSE = 0.1, 0.5, 0.5
"""Largest growth of the sum of squares at a place: the first number, plus the smaller of the third
and the second times the sum before. It may grow because its neighbours may gain more."""
TERMS = ("intersection", "exclusion", "shape", "smooth")
"""The names of the losses that are recorded."""

State = TypeVar("State")


class Problem(Protocol[State]):
    """A least-squares problem over a state. Closest points and intruders
    are fixed during a step."""

    free: NDArray[np.bool_]
    """Whether each unknown may change, ``(U,)``."""
    units: Floats | None
    """The unit of each unknown, ``(U,)``; None if all are 1."""
    width: int
    """Number of unknowns in a row that belong together, such as those of a sphere."""
    count: int
    """The number by which recorded losses are divided."""
    threads: int
    """Number of threads that compute a step."""

    def prepare(self, state: State, factor: float) -> None:
        """Find closest points and intruders, and multiply the weights of
        conformity by ``factor``."""
        ...

    def residuals(self, state: State) -> dict[str, Floats]:
        """The residuals of each term. Those of TERMS are recorded."""
        ...

    def blocks(self, state: State, residuals: dict[str, Floats]) -> list[Block]:
        """The residuals with their derivatives."""
        ...

    def moved(self, state: State, step: Floats) -> State:
        """The state after ``step (U,)``, whose length is limited."""
        ...

    def energies(self, residuals: dict[str, Floats]) -> Floats:
        """The sum of squares at each place, ``(P,)``."""
        ...

    def around(self, places: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """``places (P,)`` and their neighbours."""
        ...

    def spread(self, values: Floats) -> Floats:
        """The values of places ``(P,)`` at the unknowns, ``(U,)``."""
        ...


def first_damping(places: int) -> Floats:
    """The first damping of each place, ``(P,)``."""
    return np.full(places, DAMPING[0])


@np.errstate(over="ignore", invalid="ignore")  # values that are not finite are handled below
def descend(
    problem: Problem[State], state: State, factors: Sequence[float], damping: Floats
) -> tuple[State, Floats, Floats]:
    """Take one step for each of ``factors``.

    Returns the state, the losses ``(steps, 4)`` before each step, and the damping of each place
    ``(P,)``. A step is shortened only at places where it makes the sum of squares grow, so that one
    triangle that is hard to move does not hold up the others. Raises NumericalFailure if a loss is
    not finite.
    """
    losses = []
    for factor in factors:
        problem.prepare(state, factor)
        residuals = problem.residuals(state)
        before = problem.energies(residuals)
        if not np.isfinite(before).all():
            raise NumericalFailure("sphere-train: a loss is not finite; lower the weights")
        losses.append([float(residuals[key] @ residuals[key]) / problem.count for key in TERMS])
        blocks = problem.blocks(state, residuals)
        system = GaussNewton(blocks, problem.free, problem.units, problem.threads, problem.width)
        step = system.step(problem.spread(damping))
        bound = before + WORSE[0] + np.minimum(WORSE[1] * before, WORSE[2])
        share = np.ones(len(before))
        for trial in range(TRIALS):
            moved = problem.moved(state, problem.spread(share) * step)
            residuals = problem.residuals(moved)
            # Comparing with <= makes values that are not finite count as worse.
            after = problem.energies(residuals)
            worse = ~(after <= bound) & (share > 0)
            if not worse.any():
                break
            share[problem.around(worse)] *= SHORTER if trial < TRIALS - 2 else 0.0
        # The total is not compared, because one place may outweigh all others.
        if np.isfinite(after).all():
            state = moved
        damping = np.where(share < 1, HARDER * damping, damping / EASIER).clip(*DAMPING[1:])
    return state, np.array(losses), damping
