"""Products with the normal matrix of a sparse Jacobian, and with the inverse of its blocks."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from ..compiled import compiled
from ..mesh.polygons import Floats, Ints

Product = Callable[[Floats], Floats]

LARGE = 300_000
"""With fewer entries, distributing the rows to threads takes longer than it saves."""
CHUNKS = 4
"""Number of parts of a large matrix. It does not depend on the number of threads, and so neither
does the order in which the result is summed."""
LEAST_PIVOT = 1e-12
"""Smallest pivot of a block, as a share of its diagonal."""


def normal_product(matrix: Any, pool: ThreadPoolExecutor) -> Product:
    """A function that multiplies a vector by ``matrix.T @ matrix``.

    ``matrix`` is in compressed rows. Each row is read once for both products. The result is the
    same, to the last bit, for any number of threads in the ``pool``.
    """
    starts, columns, values = matrix.indptr, matrix.indices, matrix.data
    parts = CHUNKS if len(values) > LARGE else 1
    ends = np.searchsorted(starts, np.linspace(0, len(values), parts + 1)).tolist()
    ends[0], ends[-1] = 0, len(starts) - 1
    sums = np.empty((parts, matrix.shape[1]))

    def part(number: int, vector: Floats) -> None:
        _normal_rows(starts, columns, values, vector, sums[number], *bounds[number])

    bounds = list(pairwise(ends))

    def of(vector: Floats) -> Floats:
        if parts == 1:
            part(0, vector)
            return np.asarray(sums[0].copy())
        for running in [pool.submit(part, number, vector) for number in range(parts)]:
            running.result()
        return np.asarray(sums.sum(axis=0))

    return of


def inverse_blocks(matrix: Any, shift: Floats, unknowns: Ints, width: int) -> Product:
    """A function that multiplies a vector by the inverse of the blocks of the normal matrix.

    The normal matrix is ``matrix.T @ matrix``, plus the diagonal ``shift (U,)``. Columns with the
    same number ``unknowns (U,) // width`` are a block. The numbers are sorted.
    """
    block, place = np.unique(unknowns // width, return_inverse=True)[1], unknowns % width
    factors = np.zeros((block[-1] + 1, width, width))
    factors[:, np.arange(width), np.arange(width)] = 1.0
    factors[block, place, place] = shift
    _add_blocks(matrix.indptr, matrix.indices, matrix.data, block, place, factors)
    _factorise(factors)
    whole = len(block) == factors.shape[0] * width

    def of(vector: Floats) -> Floats:
        result = np.zeros(factors.shape[:2])
        if whole:
            result.reshape(-1)[:] = vector
        else:
            result[block, place] = vector
        _solve_blocks(factors, result)
        return result.reshape(-1) if whole else np.asarray(result[block, place])

    return of


@compiled
def _normal_rows(
    starts: Any, columns: Any, values: Floats, vector: Floats, result: Floats, begin: int, end: int
) -> None:
    result[:] = 0.0
    for row in range(begin, end):
        total = 0.0
        for k in range(starts[row], starts[row + 1]):
            total += values[k] * vector[columns[k]]
        for k in range(starts[row], starts[row + 1]):
            result[columns[k]] += values[k] * total


@compiled
def _add_blocks(
    starts: Any, columns: Any, values: Floats, block: Ints, place: Ints, blocks: Floats
) -> None:
    for row in range(len(starts) - 1):
        for k in range(starts[row], starts[row + 1]):
            one = columns[k]
            for m in range(starts[row], starts[row + 1]):
                other = columns[m]
                if block[one] == block[other]:
                    blocks[block[one], place[one], place[other]] += values[k] * values[m]


@compiled
def _factorise(blocks: Floats) -> None:
    """Replace each of ``blocks (G, w, w)`` by its lower Cholesky factor."""
    width = blocks.shape[1]
    for g in range(len(blocks)):
        for j in range(width):
            pivot = blocks[g, j, j]
            least = LEAST_PIVOT * pivot
            for k in range(j):
                pivot -= blocks[g, j, k] ** 2
            blocks[g, j, j] = np.sqrt(max(pivot, least))
            for i in range(j + 1, width):
                total = blocks[g, i, j]
                for k in range(j):
                    total -= blocks[g, i, k] * blocks[g, j, k]
                blocks[g, i, j] = total / blocks[g, j, j]


@compiled
def _solve_blocks(factors: Floats, values: Floats) -> None:
    """Replace ``values (G, w)`` by the solutions of ``L L^T x = values`` with ``factors`` L."""
    width = factors.shape[1]
    for g in range(len(factors)):
        for i in range(width):
            total = values[g, i]
            for k in range(i):
                total -= factors[g, i, k] * values[g, k]
            values[g, i] = total / factors[g, i, i]
        for i in range(width - 1, -1, -1):
            total = values[g, i]
            for k in range(i + 1, width):
                total -= factors[g, k, i] * values[g, k]
            values[g, i] = total / factors[g, i, i]
