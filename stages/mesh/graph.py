"""Connected components of graphs."""

from __future__ import annotations

import numpy as np

from .polygons import Ints


def components(count: int, pairs: Ints) -> tuple[int, Ints]:
    """The number of connected components of ``count`` nodes that ``pairs (P, 2)`` join.

    The second value is the component of each node ``(count,)``. Components are numbered in the
    order of their first nodes.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.asarray(pairs).reshape(-1, 2)
    joined = np.ones(len(ends), dtype=bool)
    graph = coo_array((joined, (ends[:, 0], ends[:, 1])), shape=(count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels.astype(np.int64)
