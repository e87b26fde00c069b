"""Centroidal Voronoi tessellations (CVT): inner generators move, those of the surface are fixed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..mesh.geometry import limited
from ..voronoi.cells.grading import Grid
from ..voronoi.cells.interior import Guard
from ..voronoi.cells.moments import Moments, cell_moments
from ..voronoi.diagram.delaunay import Floats

MEMORY = 7
"""Number of steps from which the quasi-Newton direction is computed."""
REACH = 0.5
"""Largest step of a generator, in sizes of its cell."""
OVERSHOT = 0.5
"""A step is shortened if the slope at its end is more than this share of the slope at its start,
with the opposite sign."""
SHORTENED = 3
"""Largest number of times that a step is shortened."""
STOP = 1e-3, 5
"""The descent ends if it has lowered the energy by less than this share in this number of steps."""
RATE = 0.05
"""First learning rate of Adam with the paper's loss, in units of the mean size of the cells at the
start. It falls to zero along a cosine."""


def energy_gradient(points: Floats, moments: Moments) -> Floats:
    """The gradient ``2 m_i (p_i - c_i)``, ``(M, 3)``, of ``sum_i int_{V_i} rho |x - p_i|^2``.

    The sum is over all cells. Cells of fixed generators change too, but this part of the gradient
    cancels (Du, Faber and Gunzburger 1999).
    """
    return np.asarray(2 * moments.mass[:, None] * (points - moments.centroid))


@dataclass
class Descent:
    """Limited-memory BFGS steps (Liu et al. 2009) from ``points (M, 3)``.

    The inverse Hessian begins as ``1 / (2 m_i)``, so that the first step is Lloyd's: to the
    centroids. Only gradients are computed, since energies would need the cells of the fixed
    generators. The decrease of the energy is the step times the mean of the slopes at its two ends.
    """

    guard: Guard
    density: Grid | None
    threads: int
    points: Floats
    steps: list[Floats] = field(default_factory=list)
    changes: list[Floats] = field(default_factory=list)
    won: list[float] = field(default_factory=list)
    """Decrease of the energy in each step, divided by the energy of the inner cells before it."""
    residuals: list[float] = field(default_factory=list)
    """Mean squared distance from generators to centroids before each step."""

    def __post_init__(self) -> None:
        self.moments = self._moments(self.points)

    @classmethod
    def resumed(
        cls, guard: Guard, density: Grid | None, threads: int, state: Mapping[str, Any]
    ) -> Descent:
        """A descent that continues from ``state``, with the same bits as if it had not stopped."""
        lists = {name: list(state[name]) for name in ("steps", "changes", "won", "residuals")}
        return cls(guard, density, threads, state["points"], **lists)

    @property
    def taken(self) -> int:
        """The number of steps so far."""
        return len(self.won)

    def state(self) -> dict[str, Any]:
        """The arrays from which ``resumed`` continues."""
        empty = np.zeros((0, *self.points.shape))
        return {
            "points": self.points,
            "steps": np.array(self.steps) if self.steps else empty,
            "changes": np.array(self.changes) if self.changes else empty,
            "won": np.array(self.won),
            "residuals": np.array(self.residuals),
        }

    def _moments(self, points: Floats) -> Moments:
        return cell_moments(
            np.concatenate([points, self.guard.within]), len(points), self.density, self.threads
        )

    @property
    def residual(self) -> float:
        return float(((self.points - self.moments.centroid) ** 2).sum(axis=1).mean())

    @property
    def done(self) -> bool:
        part, steps = STOP
        return len(self.won) >= steps and sum(self.won[-steps:]) < part

    def step(self) -> None:
        gradient = energy_gradient(self.points, self.moments)
        way = self._direction(gradient)
        if np.vdot(way, gradient) >= 0:
            self.steps, self.changes = [], []
            way = self._direction(gradient)
        way = limited(way, REACH * np.cbrt(self.moments.volume))
        for _ in range(SHORTENED):
            moved = self.guard.moved(self.points, way, self.threads)
            moments = self._moments(moved)
            after, taken = energy_gradient(moved, moments), moved - self.points
            slope, last = float(np.vdot(gradient, taken)), float(np.vdot(after, taken))
            if last <= -OVERSHOT * slope:
                break
            way = taken * (slope / (slope - last))
        self.residuals.append(self.residual)
        self.won.append(-0.5 * (slope + last) / float(self.moments.energy.sum()))
        change = after - gradient
        if np.vdot(taken, change) > 1e-12 * np.linalg.norm(taken) * np.linalg.norm(change):
            self.steps, self.changes = [*self.steps, taken], [*self.changes, change]
            self.steps, self.changes = self.steps[-MEMORY:], self.changes[-MEMORY:]
        self.points, self.moments = moved, moments

    def _direction(self, gradient: Floats) -> Floats:
        """The quasi-Newton direction, by the two-loop recursion."""
        way, factors = -gradient, []
        for taken, change in zip(reversed(self.steps), reversed(self.changes), strict=True):
            factor = np.vdot(taken, way) / np.vdot(taken, change)
            way = way - factor * change
            factors.append(factor)
        start = 0.5 / self.moments.mass[:, None]
        if self.steps:
            last = self.changes[-1]
            start = start * (np.vdot(self.steps[-1], last) / np.vdot(last, start * last))
        way = start * way
        for taken, change, factor in zip(self.steps, self.changes, reversed(factors), strict=True):
            way = way + (factor - np.vdot(change, way) / np.vdot(taken, change)) * taken
        return np.asarray(way)


class PaperDescent:
    """Adam on the paper's CVT loss from ``points (M, 3)``. The guard halves
    steps that are too long."""

    def __init__(
        self, guard: Guard, points: Floats, mean_area: float, threads: int, iterations: int
    ) -> None:
        import torch

        from ..solvers.adam import Moments as AdamMoments
        from ..solvers.adam import Schedule

        self.guard, self.mean_area, self.threads = guard, mean_area, threads
        self.fixed = torch.as_tensor(guard.within)
        self.points = points
        self.tensor = torch.as_tensor(points.copy()).requires_grad_()
        self.adam = AdamMoments({"points": self.tensor})
        self.residuals: list[float] = []
        rate = RATE * float(np.cbrt(self.moments.volume.mean()))
        self.schedule = Schedule(iterations, rate, "cosine", 1)

    @property
    def moments(self) -> Moments:
        """Moments of the present cells."""
        generators = np.concatenate([self.points, self.guard.within])
        return cell_moments(generators, len(self.points), threads=self.threads)

    @classmethod
    def resumed(
        cls,
        guard: Guard,
        mean_area: float,
        threads: int,
        iterations: int,
        state: Mapping[str, Any],
    ) -> PaperDescent:
        """A descent that continues from ``state``, with the same bits as if it had not stopped."""
        descent = cls(guard, state["points"], mean_area, threads, iterations)
        descent.adam.restore(state)
        descent.schedule = replace(descent.schedule, rate=float(state["rate"]))
        descent.residuals = list(state["residuals"])
        return descent

    @property
    def done(self) -> bool:
        """Always False: it ends after the number of iterations."""
        return False

    @property
    def taken(self) -> int:
        return len(self.residuals)

    def state(self) -> dict[str, Any]:
        """The arrays from which ``resumed`` continues."""
        rest = {"rate": np.array(self.schedule.rate), "residuals": np.array(self.residuals)}
        return {**self.adam.as_arrays(), **rest}

    def step(self) -> None:
        import torch

        from .losses.cvt import cvt

        loss = cvt(self.tensor, self.fixed, self.mean_area)
        gradient = torch.autograd.grad(loss, [self.tensor])
        rate = self.schedule.rate_at(self.taken)
        self.adam.step(gradient, self.taken, rate)
        self.residuals.append(float(loss.detach()) * self.mean_area)
        step = self.tensor.detach().numpy() - self.points
        self.points = self.guard.moved(self.points, step, self.threads)
        with torch.no_grad():
            self.tensor.copy_(torch.as_tensor(self.points))
