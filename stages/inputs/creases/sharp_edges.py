"""The creases of an input: chains of edges where its surface bends sharply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mesh.creases import Chain
from ...mesh.geometry import triangle_normals
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints

ANGLE = 40.0
"""Degrees from which on edges of an input are creases, unless said otherwise."""
DETAIL = 1.0
"""In units of h0: connected creases whose chains are mostly shorter are detail or noise."""
SHORTEST = 2.0
"""In units of h0: creases that reach less far are noise or detail."""
TURN = 0.5
"""Cosine below which a crease turns a corner."""


def of_triangles(vertices: Floats, triangles: Ints, angle: float) -> list[Chain]:
    """The creases of a mesh in model units, between corners."""
    return chains(vertices, sharp_edges(vertices, triangles, angle)[0])


def sharp_edges(vertices: Floats, triangles: Ints, angle: float) -> tuple[Ints, Ints]:
    """Edges at which two triangles turn by ``angle`` degrees or more, and these triangles,
    ``(E, 2)`` both."""
    normal, _ = triangle_normals(vertices, triangles)
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    ends = np.sort(np.stack([start, end], 1), axis=1)
    pairs, which, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    first = np.cumsum(uses) - uses
    two = np.flatnonzero(uses == 2)
    owner = np.repeat(np.arange(len(triangles)), 3)[order]
    owners = np.stack([owner[first[two]], owner[first[two] + 1]], axis=1)
    cosine = np.einsum("ij,ij->i", normal[owners[:, 0]], normal[owners[:, 1]])
    sharp = cosine < np.cos(np.radians(angle))
    return pairs[two[sharp]], owners[sharp]


def chains(vertices: Floats, edges: Ints) -> list[Chain]:
    """The creases that ``edges (E, 2)`` make, between corners."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    count = len(vertices)
    edges = edges[_reaching(vertices, edges)]
    degree = np.bincount(edges.reshape(-1), minlength=count)
    corner = (degree > 0) & (degree != 2)
    corner |= _turning(vertices, edges, degree == 2)
    # A chain is a component of the edges that meet elsewhere than in corners: each end that is a
    # corner gets a number of its own.
    flat = edges.reshape(-1).copy()
    cut = np.flatnonzero(corner[flat])
    flat[cut] = count + np.arange(len(cut))
    ends = flat.reshape(-1, 2)
    size = count + len(cut)
    origin = np.concatenate([np.arange(count), edges.reshape(-1)[cut]])
    _, label = components(size, ends)
    graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(size, size))
    way = vertices[edges[:, 0]] - vertices[edges[:, 1]]
    edge = np.linalg.norm(way, axis=1)
    lengths = np.asarray(np.bincount(label[ends[:, 0]], edge, label.max() + 1), np.float64)
    used = np.unique(ends)
    used = used[_coarse(lengths, label[ends[:, 0]], edges, count)[label[used]]]
    valence = np.bincount(ends.reshape(-1), minlength=size)
    result = []
    for number in np.unique(label[used]):
        members = used[label[used] == number]
        tips = members[valence[members] == 1]
        begin = int(tips[0]) if len(tips) else int(members[0])
        if len(tips):
            walk, _ = breadth_first_order(graph, begin, directed=False)
        else:
            walk = _around(ends[label[ends[:, 0]] == number], begin)
        result.append(Chain(vertices[origin[walk]], closed=len(tips) == 0))
    return result


def _coarse(lengths: Floats, chain: Ints, edges: Ints, count: int) -> NDArray[np.bool_]:
    """Which chains belong to connected creases that are not mostly detail; ``lengths (C,)`` of
    all, and the ``chain (E,)`` of each edge."""
    kept = np.zeros(len(lengths), dtype=bool)
    if len(edges) == 0:
        return kept
    _, label = components(count, edges)
    chains, first = np.unique(chain, return_index=True)
    group = label[edges[first, 0]]
    order = np.lexsort((lengths[chains], group))
    start = np.flatnonzero(np.diff(group[order], prepend=-1))
    many = np.diff(start, append=len(order))
    sizes = lengths[chains[order]]
    median = 0.5 * (sizes[start + (many - 1) // 2] + sizes[start + many // 2])
    kept[chains[order]] = np.repeat(median >= DETAIL, many)
    return kept


def _around(ends: Ints, begin: int) -> Ints:
    """The vertices of one closed chain in order, the first again at the end: without one of its
    edges it is no longer closed."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    row = int(np.flatnonzero((ends == begin).any(axis=1))[0])
    rest = np.delete(ends, row, axis=0)
    size = int(ends.max()) + 1
    graph = csr_array((np.ones(len(rest)), (rest[:, 0], rest[:, 1])), shape=(size, size))
    walk, _ = breadth_first_order(graph, begin, directed=False)
    return np.append(walk, begin)


def _reaching(vertices: Floats, edges: Ints) -> NDArray[np.bool_]:
    """Edges of connected creases that reach far enough."""
    count = len(vertices)
    if len(edges) == 0:
        return np.zeros(0, dtype=bool)
    number, label = components(count, edges)
    low, high = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
    at = edges.reshape(-1)
    np.minimum.at(low, label[at], vertices[at])
    np.maximum.at(high, label[at], vertices[at])
    reach = np.linalg.norm(np.where(high >= low, high - low, 0.0), axis=1)
    return np.asarray(reach[label[edges[:, 0]]] >= SHORTEST)


def _turning(vertices: Floats, edges: Ints, plain: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Vertices of two edges, ``plain (V,)``, at which these make a turn."""
    total = np.zeros_like(vertices)
    way = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), np.finfo(float).tiny)
    np.add.at(total, edges[:, 0], way)
    np.subtract.at(total, edges[:, 1], way)
    # Of unit ways u and v out of the vertex |u + v|^2 is 2 + 2 u.v, and u.v is -1 straight on.
    return np.asarray(plain & ((total**2).sum(axis=1) / 2 - 1 > -TURN))
