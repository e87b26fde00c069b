"""Damped Gauss-Newton steps for sparse least squares (Levenberg 1944, Marquardt 1963)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface.polygons import Floats, Ints

TOLERANCE, ITERATIONS = 1e-2, 80
"""Of the conjugate gradients; a step need not be exact."""


@dataclass(frozen=True)
class Block:
    """Residuals ``(R,)`` and the entries of their Jacobian: ``rows, columns, values (N,)``."""

    rows: Ints
    columns: Ints
    values: Floats
    residual: Floats

    @classmethod
    def dense(cls, columns: Ints, values: Floats, residual: Floats) -> Block:
        """Rows of as many entries each, ``columns, values (R, k)``."""
        width = int(np.prod(columns.shape[1:]))
        rows = np.repeat(np.arange(len(residual)), width)
        return cls(rows, columns.reshape(-1), values.reshape(-1), residual)


@dataclass(frozen=True)
class GaussNewton:
    """Steps that lessen ``sum residual^2`` over the unknowns that are ``free (U,)``."""

    blocks: Sequence[Block]
    free: NDArray[np.bool_]

    @cached_property
    def _system(self) -> tuple[Any, Any, Floats, Floats]:
        """The Jacobian, its transpose, the gradient and the squares of the columns."""
        from scipy.sparse import csr_array

        ends = np.cumsum([len(block.residual) for block in self.blocks])
        starts = ends - [len(block.residual) for block in self.blocks]
        rows = np.concatenate([b.rows + at for b, at in zip(self.blocks, starts, strict=True)])
        columns = np.concatenate([block.columns for block in self.blocks])
        values = np.concatenate([block.values for block in self.blocks])
        residual = np.concatenate([block.residual for block in self.blocks])
        used = self.free[columns] & (values != 0)
        number = np.cumsum(self.free) - 1
        # Rows without a free unknown have no part in the step.
        kept = np.zeros(ends[-1], dtype=bool)
        kept[rows[used]] = True
        rows = (np.cumsum(kept) - 1)[rows[used]]
        shape = (int(kept.sum()), int(self.free.sum()))
        jacobian = csr_array((values[used], (rows, number[columns[used]])), shape=shape)
        transpose = jacobian.T.tocsr()
        squares = np.bincount(jacobian.indices, jacobian.data**2, minlength=shape[1])
        gradient = np.asarray(transpose @ residual[kept])
        return jacobian, transpose, gradient, np.asarray(squares, np.float64)

    def step(self, damping: float) -> Floats:
        """The step ``(U,)`` with ``damping`` in units of the mean square of a column."""
        from scipy.sparse.linalg import LinearOperator, cg

        jacobian, transpose, gradient, squares = self._system
        result = np.zeros(len(self.free))
        if len(gradient) == 0:
            return result
        shift = damping * squares.mean()
        shape = (len(gradient), len(gradient))
        result[self.free], _ = cg(
            LinearOperator(shape, lambda x: transpose @ (jacobian @ x) + shift * x),
            -gradient,
            rtol=TOLERANCE,
            maxiter=ITERATIONS,
            M=LinearOperator(shape, lambda x: x / (squares + shift)),
        )
        return result
