"""The creases of an input: chains of edges where its surface bends sharply."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..surface.creases import Chain
from ..surface.geometry import triangle_normals
from ..surface.polygons import Floats, Ints

if TYPE_CHECKING:
    from ..surface.model_frame import ModelFrame
    from .protocol import Source

ANGLE = 40.0
"""Degrees from which on edges of an input are creases, unless said otherwise."""
DETAIL = 1.0
"""In units of h0: connected creases whose chains are mostly shorter are detail or noise."""
TURN = 0.5
"""Cosine below which a crease turns a corner."""
SHORTEST = 2.0
"""In units of h0: creases that reach less far are noise or detail."""


def found(source: Source, frame: ModelFrame, angle: float) -> list[Chain]:
    """The creases of an input in model units that turn by ``angle`` degrees or more; of meshes,
    and of fields, where the gradient jumps."""
    from .contouring import contoured
    from .fields import FieldSource
    from .mesh import MeshSource

    if isinstance(source, FieldSource):
        return of_triangles(*contoured(source, frame), angle)
    if isinstance(source, MeshSource):
        return of_triangles(frame.model_from_input(source.vertices), source.triangles, angle)
    return []


def of_triangles(vertices: Floats, triangles: Ints, angle: float) -> list[Chain]:
    """The creases of a mesh in model units, between corners."""
    normal, _ = triangle_normals(vertices, triangles)
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    ends = np.sort(np.stack([start, end], 1), axis=1)
    pairs, which, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    first = np.cumsum(uses) - uses
    two = np.flatnonzero(uses == 2)
    owner = np.repeat(np.arange(len(triangles)), 3)[order]
    cosine = np.einsum("ij,ij->i", normal[owner[first[two]]], normal[owner[first[two] + 1]])
    sharp = pairs[two[cosine < np.cos(np.radians(angle))]]
    return _chains(vertices, sharp)


def _chains(vertices: Floats, edges: Ints) -> list[Chain]:
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components

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
    ones = np.ones(len(ends))
    graph = csr_array((ones, (ends[:, 0], ends[:, 1])), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    used = np.unique(ends)
    valence = np.bincount(ends.reshape(-1), minlength=size)
    chains, places = [], []
    for number in np.unique(label[used]):
        members = used[label[used] == number]
        tips = members[valence[members] == 1]
        begin = int(tips[0]) if len(tips) else int(members[0])
        if len(tips):
            walk, _ = breadth_first_order(graph, begin, directed=False)
        else:
            walk = _around(ends[label[ends[:, 0]] == number], begin)
        chains.append(Chain(vertices[origin[walk]], closed=len(tips) == 0))
        places.append(int(origin[walk[0]]))
    return _coarse(chains, np.array(places, dtype=np.int64), edges, count)


def _coarse(chains: list[Chain], places: Ints, edges: Ints, count: int) -> list[Chain]:
    """The ``chains`` of connected creases that are not mostly detail; a vertex of each is given."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    if not chains:
        return []
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    length = np.array([chain.length for chain in chains])
    return [
        chain for chain, place in zip(chains, places, strict=True)
        if np.median(length[label[places] == label[place]]) >= DETAIL
    ]  # fmt: skip


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
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    count = len(vertices)
    if len(edges) == 0:
        return np.zeros(0, dtype=bool)
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    number, label = connected_components(graph, directed=False)
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
