"""Damped Gauss-Newton steps for sparse least squares (Levenberg 1944, Marquardt 1963)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

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
class Normal:
    """The normal equations of ``sum residual^2`` in ``unknowns`` unknowns."""

    blocks: Sequence[Block]
    unknowns: int

    @cached_property
    def _system(self) -> tuple[Any, Floats]:
        from scipy.sparse import csr_array

        ends = np.cumsum([len(block.residual) for block in self.blocks])
        starts = ends - [len(block.residual) for block in self.blocks]
        rows = np.concatenate([b.rows + at for b, at in zip(self.blocks, starts, strict=True)])
        columns = np.concatenate([block.columns for block in self.blocks])
        values = np.concatenate([block.values for block in self.blocks])
        jacobian = csr_array((values, (rows, columns)), shape=(ends[-1], self.unknowns))
        residual = np.concatenate([block.residual for block in self.blocks])
        return (jacobian.T @ jacobian).tocsr(), jacobian.T @ residual

    def step(self, damping: float, free: Floats | None = None) -> Floats:
        """The step ``(unknowns,)`` with ``damping`` in units of the mean diagonal.

        ``free (unknowns,)``: 0 where an unknown is to stay, 1 elsewhere.
        """
        from scipy.sparse.linalg import LinearOperator, cg

        matrix, gradient = self._system
        diagonal = matrix.diagonal()
        shift = damping * diagonal.mean()
        mask = np.ones(self.unknowns) if free is None else free
        step, _ = cg(
            LinearOperator(matrix.shape, lambda x: mask * (matrix @ (mask * x)) + shift * x),
            -mask * gradient,
            rtol=TOLERANCE,
            maxiter=ITERATIONS,
            M=LinearOperator(matrix.shape, lambda x: x / (diagonal + shift)),
        )
        return np.asarray(mask * step)
