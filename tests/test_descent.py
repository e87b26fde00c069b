"""Damped Gauss-Newton steps: their solutions, and where they are shortened."""

from __future__ import annotations

import numpy as np
import pytest

from vorolight.stages.errors import NumericalFailure
from vorolight.stages.optimize.descent import SHORTER, TERMS, descend, first_damping
from vorolight.stages.optimize.least_squares import Block, GaussNewton


class Cliffs:
    """``(x - 3)^2`` for each of the unknowns, up to a point beyond which it has no finite value."""

    count, units = 1, None

    def __init__(self, *edges: float) -> None:
        self.edges = np.array(edges)
        self.free = np.ones(len(edges), bool)

    def prepare(self, state: np.ndarray, factor: float) -> None:
        pass

    def residuals(self, state: np.ndarray) -> dict[str, np.ndarray]:
        value = np.where(state <= self.edges, state - 3.0, np.inf)
        return {name: value if name == "shape" else np.zeros(1) for name in TERMS}

    def blocks(self, state: np.ndarray, residuals: dict[str, np.ndarray]) -> list[Block]:
        column = np.arange(len(self.edges))[:, None]
        return [Block.dense(column, np.ones(column.shape), residuals["shape"])]

    def moved(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step

    def energies(self, residuals: dict[str, np.ndarray]) -> np.ndarray:
        return residuals["shape"] ** 2

    def around(self, places: np.ndarray) -> np.ndarray:
        return places

    def spread(self, values: np.ndarray) -> np.ndarray:
        return values


def test_a_step_to_what_is_not_finite_is_not_taken() -> None:
    def to(*edges: float, steps: int = 1) -> tuple[np.ndarray, np.ndarray]:
        start = np.zeros(len(edges)), [1.0] * steps, first_damping(len(edges))
        return descend(Cliffs(*edges), *start)[:2]

    assert to(5.0, steps=8)[0] == pytest.approx(3, abs=1e-3)
    # The whole step leads too far, and is shortened.
    state, losses = to(1.5)
    assert state == pytest.approx(SHORTER * 3 / 1.01)
    assert np.isfinite(losses).all()
    with pytest.raises(NumericalFailure, match="not finite"):
        to(-1.0)


def test_a_place_that_cannot_be_moved_keeps_no_other_from_its_step() -> None:
    start = np.zeros(3), [1.0] * 8, first_damping(3)
    state, _, damping = descend(Cliffs(5.0, 1e-9, 5.0), *start)
    assert state[[0, 2]] == pytest.approx(3, abs=1e-3)
    assert state[1] == pytest.approx(0, abs=1e-8)
    assert damping[1] > 10 > 0.01 > damping[0]


def chain(steep: float) -> tuple[list[Block], int]:
    """A long chain of springs, of which only many steps of conjugate gradients find the end, and an
    unknown that is ``steep`` and has nothing to do with it."""
    size = 60
    row = np.arange(size)
    springs = Block.dense(
        np.stack([row, np.maximum(row - 1, 0)], axis=1),
        np.stack([np.ones(size), np.where(row > 0, -1.0, 0.0)], axis=1),
        np.where(row == size - 1, 1.0, 0.0),
    )
    alone = Block.dense(np.array([[size]]), np.array([[steep]]), np.array([1.0]))
    return [springs, alone], size + 1


@pytest.mark.parametrize("damping", [1e-6, 1e-2])
def test_a_steep_unknown_hides_and_holds_back_no_others(damping: float) -> None:
    # Else it would say alone when the conjugate gradients stop, or how large the damping is.
    easy, hard = (
        GaussNewton(blocks, np.ones(count, bool)).step(damping)[:-1]
        for blocks, count in (chain(1.0), chain(1e6))
    )
    # The steep one counts as a hundred in the mean over 61.
    assert np.linalg.norm(hard) > 0.5 * np.linalg.norm(easy) > 0


def test_damping_is_in_units_of_each_unknown() -> None:
    block = Block.dense(np.arange(2)[:, None], np.array([[1.0], [0.01]]), np.array([1.0, 0.01]))
    free = np.ones(2, bool)
    # Half of either step is taken where a hundredth is to the second what one is to the first.
    step = GaussNewton([block], free, np.array([1.0, 100.0])).step(1.0)
    assert step == pytest.approx([-0.5, -0.5])
    assert GaussNewton([block], free).step(1.0)[1] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("mkl", [True, False])
def test_a_step_is_the_least_squares_solution(mkl: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    if not mkl:  # as where torch comes without it
        monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: False)
    random = np.random.default_rng(0)
    matrix = random.normal(size=(300, 40)) * (random.random((300, 40)) < 0.3)
    residual = random.normal(size=300)
    columns = np.broadcast_to(np.arange(40), (300, 40))
    damping = 0.05
    step = GaussNewton([Block.dense(columns, matrix, residual)], np.ones(40, bool)).step(damping)
    shift = damping * (matrix**2).sum(axis=0).mean()
    exact = np.linalg.solve(matrix.T @ matrix + shift * np.eye(40), -matrix.T @ residual)
    # The gradients stop at a hundredth of the gradient; the matrix is well conditioned.
    assert np.linalg.norm(step - exact) < 0.03 * np.linalg.norm(exact)


def test_unknowns_that_are_not_free_stay() -> None:
    columns = np.array([[0, 1], [1, 2], [0, 2]])
    values = np.array([[1.0, 2.0], [1.0, -1.0], [3.0, 1.0]])
    block = Block.dense(columns, values, np.array([1.0, 2.0, 3.0]))
    matrix = np.zeros((3, 3))
    np.add.at(matrix, (block.rows, block.columns), block.values)
    step = GaussNewton([block], np.ones(3, bool)).step(0.0)
    assert matrix @ step == pytest.approx([-1, -2, -3], rel=0.05)
    held = GaussNewton([block], np.array([True, False, True])).step(0.0)
    assert held[1] == 0
    assert (matrix.T @ (matrix @ held + [1, 2, 3]))[[0, 2]] == pytest.approx([0, 0], abs=0.2)
