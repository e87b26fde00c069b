"""The loop of damped Gauss-Newton steps, for whatever problem gives residuals and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.polygons import Floats
from .least_squares import Block, GaussNewton

DAMPING = 1e-2, 1e-4, 1e2
"""The first, the smallest and the largest."""
EASIER, HARDER = 3.0, 5.0
"""What the damping is divided by where a step was taken whole, and multiplied with elsewhere."""
TRIALS, SHORTER = 5, 0.3
"""How often a step is shortened where it makes things worse, and the factor; the last time the step
is not taken there."""
WORSE = 0.1, 0.5, 0.5
"""By how much the sum of squares at a place may grow, since its neighbours may gain more: by the
first, and this share of what it was, but the share by no more than the last."""
TERMS = ("intersection", "exclusion", "shape", "smooth")
"""The losses that are recorded."""

State = TypeVar("State")


class Problem(Protocol[State]):
    """Least squares in a state; what is near or facing is fixed during a step."""

    free: NDArray[np.bool_]
    """Which unknowns may change, ``(U,)``."""
    units: Floats | None
    """What they are measured in, ``(U,)``."""
    count: int
    """What the recorded losses are divided by."""
    threads: int
    """On which steps are computed."""

    def prepare(self, state: State, factor: float) -> None:
        """Fix what is near or facing, and multiply what conformity needs by ``factor``."""
        ...

    def residuals(self, state: State) -> dict[str, Floats]:
        """Residuals by term; those of TERMS are recorded."""
        ...

    def blocks(self, state: State, residuals: dict[str, Floats]) -> list[Block]:
        """The residuals with their derivatives."""
        ...

    def moved(self, state: State, step: Floats) -> State:
        """The state after a step of the unknowns, limited in length."""
        ...

    def energies(self, residuals: dict[str, Floats]) -> Floats:
        """The sums of the squares around each of the places ``(P,)`` where a step may be taken or
        not."""
        ...

    def around(self, places: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """``places (P,)`` and what is beside them."""
        ...

    def spread(self, values: Floats) -> Floats:
        """What the unknowns ``(U,)`` have of values at the places ``(P,)``."""
        ...


def first_damping(places: int) -> Floats:
    """Of each place, ``(P,)``."""
    return np.full(places, DAMPING[0])


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is looked for
def descend(
    problem: Problem[State], state: State, factors: Sequence[float], damping: Floats
) -> tuple[State, Floats, Floats]:
    """A step for each of ``factors``: the state, the losses ``(steps, 4)`` before each step and
    the damping at each place ``(P,)``.

    A step is shortened only around the places where it makes things worse: one triangle that is
    hard to move does not keep all others from theirs. Raises NumericalFailure when a loss is not
    finite.
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
        system = GaussNewton(blocks, problem.free, problem.units, problem.threads)
        step = system.step(problem.spread(damping))
        bound = before + WORSE[0] + np.minimum(WORSE[1] * before, WORSE[2])
        share = np.ones(len(before))
        for trial in range(TRIALS):
            moved = problem.moved(state, problem.spread(share) * step)
            residuals = problem.residuals(moved)
            # What is not finite is worse too.
            after = problem.energies(residuals)
            worse = ~(after <= bound) & (share > 0)
            if not worse.any():
                break
            share[problem.around(worse)] *= SHORTER if trial < TRIALS - 2 else 0.0
        # The sum of all says little: one place may outweigh the others.
        if np.isfinite(after).all():
            state = moved
        damping = np.where(share < 1, HARDER * damping, damping / EASIER).clip(*DAMPING[1:])
    return state, np.array(losses), damping
