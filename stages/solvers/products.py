"""Products of a sparse matrix and a vector, on several threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from ..compiled import compiled
from ..mesh.polygons import Floats

Product = Callable[[Floats], Floats]

LARGE = 300_000
"""With fewer entries, distributing the rows to threads takes longer than it saves."""


def product(matrix: Any, pool: ThreadPoolExecutor, threads: int) -> Product:
    """A function that multiplies ``matrix``, in compressed rows, by a vector.

    It uses ``threads`` of ``pool``. The result is the same, to the last bit, for any number of
    them.
    """
    starts, columns, values = matrix.indptr, matrix.indices, matrix.data
    count = len(starts) - 1
    shared = threads > 1 and len(values) > LARGE
    wanted = np.linspace(0, len(values), (threads if shared else 1) + 1)
    ends = np.searchsorted(starts, wanted).clip(0, count).tolist()
    ends[0], ends[-1] = 0, count

    def of(vector: Floats) -> Floats:
        result = np.empty(count)
        if not shared:
            _rows(starts, columns, values, vector, result, 0, count)
        else:
            parts = [
                pool.submit(_rows, starts, columns, values, vector, result, begin, end)
                for begin, end in pairwise(ends)
            ]
            for part in parts:
                part.result()
        return result

    return of


@compiled
def _rows(
    starts: Any, columns: Any, values: Floats, vector: Floats, result: Floats, begin: int, end: int
) -> None:
    for row in range(begin, end):
        total = 0.0
        for k in range(starts[row], starts[row + 1]):
            total += values[k] * vector[columns[k]]
        result[row] = total
