"""The loop of damped Gauss-Newton steps, for whatever problem gives residuals and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..surface.polygons import Floats
from .least_squares import Block, GaussNewton

DAMPING = 1e-2, 1e-4
"""The first and the smallest."""
EASIER, HARDER, TRIALS = 3.0, 5.0, 4
"""What the damping is divided by after a step that lowers the sum of squares, what it is
multiplied with after one that does not, and how often that is tried."""
TERMS = ("intersection", "exclusion", "shape", "smooth")
"""The losses that are recorded."""

State = TypeVar("State")


class Problem(Protocol[State]):
    """Least squares in a state; what is near or facing is fixed during a step."""

    free: NDArray[np.bool_]
    """Which unknowns may change."""
    count: int
    """What the recorded losses are divided by."""

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


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is looked for
def descend(
    problem: Problem[State], state: State, factors: Sequence[float], damping: float
) -> tuple[State, Floats, float]:
    """A step for each of ``factors``: the state, the losses ``(steps, 4)`` before each step and
    the damping. Raises NumericalFailure when a loss is not finite."""
    losses = []
    for factor in factors:
        problem.prepare(state, factor)
        residuals = problem.residuals(state)
        total = sum(float(part @ part) for part in residuals.values())
        if not np.isfinite(total):
            raise NumericalFailure("sphere-train: a loss is not finite; lower the weights")
        losses.append([float(residuals[key] @ residuals[key]) / problem.count for key in TERMS])
        system = GaussNewton(problem.blocks(state, residuals), problem.free)
        for _ in range(TRIALS):
            moved = problem.moved(state, system.step(damping))
            after = sum(float(part @ part) for part in problem.residuals(moved).values())
            if after < total:  # false also where it is not finite
                state = moved
                damping = max(damping / EASIER, DAMPING[1])
                break
            damping *= HARDER
    return state, np.array(losses), damping
