"""Damped Gauss-Newton steps for sparse least squares (Levenberg 1944, Marquardt 1963)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints
from .products import Product, inverse_blocks, normal_product

TOLERANCE, ITERATIONS = 1e-2, 80
"""Relative tolerance of the conjugate gradients, and their largest number of iterations. A
step need not be exact."""
STEEP = 100.0
"""A squared column above so many medians counts as that much in the mean
that scales the damping."""


@dataclass(frozen=True)
class Block:
    """Residuals ``(R,)``, and the entries of their Jacobian as ``rows``,
    ``columns``, ``values (N,)``."""

    rows: Ints
    columns: Ints
    values: Floats
    residual: Floats

    @classmethod
    def dense(cls, columns: Ints, values: Floats, residual: Floats) -> Block:
        """A block in which every row has k entries; ``columns`` and ``values`` are ``(R, k)``."""
        width = int(np.prod(columns.shape[1:]))
        rows = np.repeat(np.arange(len(residual)), width)
        return cls(rows, columns.reshape(-1), values.reshape(-1), residual)


@dataclass(frozen=True)
class GaussNewton:
    """Steps that lower ``sum residual^2`` over the unknowns that are ``free (U,)``.

    Each unknown is measured in its unit, ``units (U,)``. Every ``width`` unknowns in a row belong
    together, such as the coordinates of a vertex, and are preconditioned together.
    """

    blocks: Sequence[Block]
    free: NDArray[np.bool_]
    units: Floats | None = None
    threads: int = 1
    width: int = 1

    @cached_property
    def _system(self) -> tuple[Any, Floats, Floats]:
        """The Jacobian, the gradient, and the squares of the columns."""
        from scipy.sparse import csr_array

        ends = np.cumsum([len(block.residual) for block in self.blocks])
        starts = ends - [len(block.residual) for block in self.blocks]
        rows = np.concatenate([b.rows + at for b, at in zip(self.blocks, starts, strict=True)])
        columns = np.concatenate([block.columns for block in self.blocks])
        values = np.concatenate([block.values for block in self.blocks])
        residual = np.concatenate([block.residual for block in self.blocks])
        used = self.free[columns] & (values != 0)
        number = np.cumsum(self.free) - 1
        # Rows without a free unknown do not affect the step.
        kept = np.zeros(ends[-1], dtype=bool)
        kept[rows[used]] = True
        rows = (np.cumsum(kept) - 1)[rows[used]]
        shape = (int(kept.sum()), int(self.free.sum()))
        # Products read half the memory with 32-bit indices, which are used if they suffice.
        index = np.int32 if max(len(rows), *shape) < 2**31 else np.int64
        places = rows.astype(index), number[columns[used]].astype(index)
        jacobian = csr_array((values[used], places), shape=shape)
        squares = np.bincount(jacobian.indices, jacobian.data**2, minlength=shape[1])
        gradient = np.asarray(jacobian.T @ residual[kept])
        return jacobian, gradient, np.asarray(squares, np.float64)

    def step(self, damping: float | Floats) -> Floats:
        """The step ``(U,)``. ``damping`` is one number, or one for each unknown ``(U,)``.

        Its unit is the mean square of a column, in which squares above STEEP medians count as that
        much.
        """
        jacobian, gradient, squares = self._system
        result = np.zeros(len(self.free))
        if not gradient.any():
            return result
        units = np.ones(len(squares)) if self.units is None else self.units[self.free]
        each = np.broadcast_to(damping, len(self.free))[self.free]
        square = squares * units**2
        # Otherwise a few steep columns would damp all unknowns.
        typical = np.median(square[square > 0])
        shift = each * np.minimum(square, STEEP * typical).mean() / units**2
        inverse = inverse_blocks(jacobian, shift, np.flatnonzero(self.free), self.width)
        with ThreadPoolExecutor(self.threads) as pool:
            normal = normal_product(jacobian, pool)
            result[self.free] = conjugate_gradients(
                lambda x: normal(x) + shift * x, -gradient, inverse
            )
        return result


def conjugate_gradients(product: Product, right: Floats, inverse: Product) -> Floats:
    """A solution ``x (U,)`` of ``product(x) = right``, up to TOLERANCE.

    ``inverse`` multiplies by the inverse of the preconditioner.
    """
    x, rest = np.zeros_like(right), right.copy()
    # The residual is measured in the preconditioner's norm: otherwise steep unknowns would hide
    # the others.
    close = TOLERANCE**2 * (right @ inverse(right))
    direction, before = np.zeros_like(right), 1.0
    for _ in range(ITERATIONS):
        scaled = inverse(rest)
        now = float(rest @ scaled)
        if now <= close:
            break
        direction *= now / before
        direction += scaled
        before = now
        image = product(direction)
        length = now / float(direction @ image)
        x += length * direction
        rest -= length * image
    return x
