"""Damped Gauss-Newton steps: their solutions, and where they are shortened."""

from __future__ import annotations

import numpy as np
import pytest

from vorolight.stages.errors import NumericalFailure
from vorolight.stages.solvers import products
from vorolight.stages.solvers.gauss_newton import SHORTER, TERMS, descend, first_damping
from vorolight.stages.solvers.least_squares import (
    TOLERANCE,
    Block,
    GaussNewton,
    conjugate_gradients,
)


class Cliffs:
    """``(x - 3)^2`` for each of the unknowns, up to a point beyond which it has no finite value."""

    count, width, units, threads = 1, 1, None, 1

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


STEEP = 1e6


def chain() -> Block:
    """Twenty springs in a row, pulled at the end, and an unknown that is STEEP for itself."""
    row = np.arange(20)
    rows = np.concatenate([row, row[1:], [20]])
    columns = np.concatenate([row, row[:-1], [20]])
    values = np.concatenate([np.ones(20), -np.ones(19), [STEEP]])
    return Block(rows, columns, values, np.concatenate([np.zeros(19), [0.1, 1.0]]))


def test_conjugate_gradients_do_not_stop_when_the_steepest_unknown_is_found() -> None:
    block = chain()
    dense = np.zeros((21, 21))
    dense[block.rows, block.columns] = block.values
    matrix, right = dense.T @ dense, -dense.T @ block.residual
    inverse = 1 / matrix.diagonal()
    found = conjugate_gradients(lambda x: matrix @ x, right, lambda x: inverse * x)
    rest = right - matrix @ found
    assert rest @ (inverse * rest) <= 1.01 * TOLERANCE**2 * right @ (inverse * right)


def test_a_steep_unknown_does_not_hold_back_others() -> None:
    # In the mean that damping is in units of it would be all, so that nothing else moved.
    step = GaussNewton([chain()], np.ones(21, bool)).step(1e-2)
    assert np.linalg.norm(step[:-1]) > 0.05


def test_damping_is_in_units_of_each_unknown() -> None:
    block = Block.dense(np.arange(2)[:, None], np.array([[1.0], [0.01]]), np.array([1.0, 0.01]))
    free = np.ones(2, bool)
    # Half of either step is taken where a hundredth is to the second what one is to the first.
    step = GaussNewton([block], free, np.array([1.0, 100.0])).step(1.0)
    assert step == pytest.approx([-0.5, -0.5])
    assert GaussNewton([block], free).step(1.0)[1] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_step_is_the_least_squares_solution(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "LARGE", 100)
    random = np.random.default_rng(0)
    matrix = random.normal(size=(300, 40)) * (random.random((300, 40)) < 0.3)
    residual = random.normal(size=300)
    columns = np.broadcast_to(np.arange(40), (300, 40))
    damping = 0.05
    block = Block.dense(columns, matrix, residual)
    step = GaussNewton([block], np.ones(40, bool), threads=threads).step(damping)
    assert np.array_equal(step, GaussNewton([block], np.ones(40, bool)).step(damping))
    shift = damping * (matrix**2).sum(axis=0).mean()
    exact = np.linalg.solve(matrix.T @ matrix + shift * np.eye(40), -matrix.T @ residual)
    # The gradients stop at a hundredth of the gradient; the matrix is well conditioned.
    assert np.linalg.norm(step - exact) < 0.03 * np.linalg.norm(exact)


def test_blocks_are_those_of_the_normal_matrix() -> None:
    from scipy.sparse import csr_array

    random = np.random.default_rng(0)
    matrix = random.normal(size=(200, 11)) * (random.random((200, 11)) < 0.3)
    # Of the first vertex two coordinates are unknown, of the others three, three and three.
    unknowns = np.array([0, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14])
    shift, right = 0.1 + random.random(11), random.normal(size=11)
    dense = matrix.T @ matrix + np.diag(shift)
    dense[(unknowns[:, None] // 3) != (unknowns // 3)] = 0
    found = products.inverse_blocks(csr_array(matrix), shift, unknowns, 3)(right)
    assert found == pytest.approx(np.linalg.solve(dense, right), rel=1e-10)


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
