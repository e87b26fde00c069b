"""The training loop with Adam: learning rates, checkpoints, and the history of the losses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from ..errors import NumericalFailure

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..progress import Progress

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
"""Adam's constants (Kingma and Ba 2015)."""

LESS = 1e-3
"""Smallest relative decrease of the total loss that counts as progress, if
training may end early."""

Losses = Callable[[int], dict[str, torch.Tensor]]


@dataclass(frozen=True)
class Schedule:
    """Number of iterations and learning rates."""

    iterations: int
    rate: float
    decay: Literal["constant", "cosine", "halving"]
    checkpoint_every: int
    """Number of iterations between checkpoints. It must be a multiple of each interval
    at which ``losses`` renews cached values, so that a resumed run gives the same bits
    as an uninterrupted one."""
    patience: int | None = None
    """Training ends after this number of iterations without progress; None never ends it early."""
    halvings: tuple[float, ...] = ()
    """Shares of the iterations after which the learning rate is halved, if ``decay`` is halving."""

    def rate_at(self, iteration: int) -> float:
        """The learning rate at ``iteration``, counted from 0."""
        if self.decay == "constant":
            return self.rate
        if self.decay == "halving":
            passed = sum(iteration >= share * self.iterations for share in self.halvings)
            return self.rate * 0.5**passed
        return 0.5 * self.rate * (1 + math.cos(math.pi * iteration / self.iterations))


class Moments:
    """Adam's running means of gradients and of their squares, for named tensors.

    It does not use torch.optim, whose import takes two seconds, more than some stages need in all.
    """

    def __init__(self, parameters: Mapping[str, torch.Tensor]) -> None:
        self.parameters = parameters
        self.means = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
        self.squares = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}

    def step(self, gradients: Sequence[torch.Tensor], iteration: int, rate: float) -> None:
        """Update the parameters in place; ``iteration`` counts from 0."""
        rate /= 1 - BETA1 ** (iteration + 1)
        with torch.no_grad():
            for (name, tensor), gradient in zip(self.parameters.items(), gradients, strict=True):
                mean, square = self.means[name], self.squares[name]
                mean.mul_(BETA1).add_(gradient, alpha=1 - BETA1)
                square.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
                scale = (square / (1 - BETA2 ** (iteration + 1))).sqrt_().add_(EPSILON)
                tensor.addcdiv_(mean, scale, value=-rate)

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Parameters and moments as arrays to be stored."""
        arrays = {}
        for name, tensor in self.parameters.items():
            arrays[name] = tensor.detach().cpu().numpy()
            arrays[f"{name}.mean"] = self.means[name].cpu().numpy()
            arrays[f"{name}.square"] = self.squares[name].cpu().numpy()
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Set parameters and moments from what ``as_arrays`` returned."""
        with torch.no_grad():
            for name, tensor in self.parameters.items():
                tensor.copy_(torch.as_tensor(arrays[name]))
                self.means[name].copy_(torch.as_tensor(arrays[f"{name}.mean"]))
                self.squares[name].copy_(torch.as_tensor(arrays[f"{name}.square"]))


def adam(
    parameters: Mapping[str, torch.Tensor],
    losses: Losses,
    weights: Mapping[str, float],
    schedule: Schedule,
    checkpoints: Checkpoints,
    progress: Progress,
    label: str,
) -> np.ndarray:
    """Minimise ``sum of weights[k] * losses(iteration)[k]`` over ``parameters``, in place.

    Resumes from the newest checkpoint. Returns the unweighted losses
    ``(iterations, len(weights))``, with fewer rows if training ended early. Raises NumericalFailure
    if a loss or gradient is not finite.
    """
    tensors = list(parameters.values())
    moments = Moments(parameters)
    history = np.zeros((schedule.iterations, len(weights)))
    first = 0
    found = checkpoints.latest()
    if found is not None:
        first, state = found
        history[:first] = state["history"]
        moments.restore(state)
    progress.start(label, schedule.iterations)
    for iteration in range(first, schedule.iterations):
        terms = losses(iteration)
        total = torch.stack([weights[key] * terms[key] for key in weights]).sum()
        gradients = torch.autograd.grad(total, tensors)
        history[iteration] = [float(terms[key].detach()) for key in weights]
        if not np.isfinite(history[iteration]).all() or not all(
            bool(gradient.isfinite().all()) for gradient in gradients
        ):
            raise NumericalFailure(
                f"{label}: a loss or gradient is not finite at iteration {iteration}; "
                "lower --learning-rate"
            )
        if _at_rest(history[: iteration + 1] @ np.array(list(weights.values())), schedule.patience):
            return history[: iteration + 1]
        moments.step(gradients, iteration, schedule.rate_at(iteration))
        progress.advance(iteration + 1, f"loss {float(total.detach()):.4g}")
        if (iteration + 1) % schedule.checkpoint_every == 0 and iteration + 1 < schedule.iterations:
            so_far = {"history": history[: iteration + 1]}
            checkpoints.save(iteration + 1, partial(_state, so_far, moments))
    return history


def _state(more: Mapping[str, np.ndarray], moments: Moments) -> dict[str, np.ndarray]:
    return {**more, **moments.as_arrays()}


def _at_rest(totals: np.ndarray, patience: int | None) -> bool:
    """Whether the last ``patience`` of ``totals`` brought no progress."""
    if patience is None or len(totals) <= patience:
        return False
    return bool(totals[-patience:].min() > (1 - LESS) * totals[:-patience].min())
