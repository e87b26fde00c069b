"""Triangles of a closed surface, merged into polygons. Vertices keep at least four edges.

Faces with more than three corners conform exactly only if their vertices have enough freedom. With
three faces at every vertex, a smooth patch can only be part of a sphere. With four, it can be any
surface. Where the surface is plane, three are enough. Whole stars of triangles around a vertex are
merged first, in the order of a lattice, and then pairs of the triangles that are left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..mesh.edge_table import EdgeTable
from ..mesh.geometry import triangle_normals
from ..mesh.polygons import Floats, Ints, PolygonMesh

KEPT, KEPT_FLAT = 4, 3
"""Smallest number of edges that a vertex keeps: in general, and where all faces at it are
plane between creases."""
BEND, FOLD = 30.0, 10.0
"""Largest angle between the normals of two triangles of a star, and of a pair, in degrees."""
TURN = 0.15
"""Smallest sine of the angle by which a merged polygon turns at a corner."""
TRIALS = 12
"""Number of starting points of the lattice that are tried."""


@dataclass(frozen=True)
class Rings:
    """The neighbours of each vertex of a closed triangle surface, counter-clockwise.

    Those of vertex v are ``vertices[offsets[v] : offsets[v + 1]]``. ``triangles`` has the triangle
    between each neighbour and the next one.
    """

    offsets: Ints
    vertices: Ints
    triangles: Ints

    @classmethod
    def of(cls, triangles: Ints, count: int) -> Rings:
        corner = triangles.reshape(-1)
        after, before = (np.roll(triangles, -shift, axis=1).reshape(-1) for shift in (1, 2))
        # The next corner at the same vertex: its triangle begins at the edge where this one ends.
        starts = corner * count + after
        order = np.argsort(starts, kind="stable")
        follows = order[np.searchsorted(starts[order], corner * count + before)]
        degree = np.bincount(corner, minlength=count)
        offsets = np.concatenate([[0], np.cumsum(degree)])
        at = np.full(count, -1)
        at[corner[::-1]] = np.arange(len(corner))[::-1]
        ring = np.full(len(corner), -1)
        for step in range(int(degree.max(initial=0))):
            going = np.flatnonzero(degree > step)
            ring[offsets[going] + step] = at[going]
            at[going] = follows[at[going]]
        return cls(offsets, after[ring], ring // 3)

    @property
    def degrees(self) -> Ints:
        return np.diff(self.offsets)

    @property
    def owners(self) -> Ints:
        """The vertex to whose ring each entry belongs."""
        return np.repeat(np.arange(len(self.offsets) - 1), self.degrees)


def _mergeable(vertices: Floats, triangles: Ints, rings: Rings, rank: Ints) -> NDArray[np.bool_]:
    """Whether each vertex ``(V,)`` is off creases and has a nearly flat star with a convex ring."""
    normal, area = triangle_normals(vertices, triangles)
    count, owner = len(vertices), rings.owners
    weighted = (area[:, None] * normal)[rings.triangles]
    parts = [np.bincount(owner, part, minlength=count) for part in weighted.T]
    middle = np.stack(parts, axis=1).astype(np.float64)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), np.finfo(float).tiny)
    # Two normals differ by at most twice their angle to the mean normal.
    cosine = np.einsum("ij,ij->i", normal[rings.triangles], middle[owner])
    good = rank == 0
    good[owner[cosine < np.cos(np.radians(BEND / 2))]] = False
    following = np.arange(1, len(owner) + 1)
    following[rings.offsets[1:] - 1] = rings.offsets[:-1]
    into = vertices[rings.vertices[following]] - vertices[rings.vertices]
    out = into[following]
    sine = np.einsum("ij,ij->i", np.cross(into, out), middle[owner])
    sine /= np.linalg.norm(into, axis=1) * np.linalg.norm(out, axis=1)
    good[owner[sine < TURN]] = False
    return np.asarray(good)


@compiled
def _grown(
    offsets: Ints, ring: Ints, spare: Ints, allowed: NDArray[np.bool_], order: Ints
) -> NDArray[np.bool_]:
    """The vertices to be removed, whose stars become polygons.

    From each one, the vertices two steps straight ahead are tried. No two removed vertices are
    neighbours, and no vertex loses more than ``spare (V,)`` edges.
    """
    count = len(offsets) - 1
    taken = np.zeros(count, dtype=np.bool_)
    queued = np.zeros(count, dtype=np.bool_)
    room = spare.copy()
    queue = np.empty(count, dtype=np.int64)
    head = tail = 0
    for seed in order:
        if not queued[seed] and allowed[seed]:
            queue[tail] = seed
            queued[seed] = True
            tail += 1
        while head < tail:
            here = queue[head]
            head += 1
            fits = True
            for k in range(offsets[here], offsets[here + 1]):
                if taken[ring[k]] or room[ring[k]] < 1:
                    fits = False
            if not fits:
                continue
            taken[here] = True
            for k in range(offsets[here], offsets[here + 1]):
                beside = ring[k]
                room[beside] -= 1
                degree = offsets[beside + 1] - offsets[beside]
                place = 0
                while ring[offsets[beside] + place] != here:
                    place += 1
                for ahead in range(degree // 2, (degree + 1) // 2 + 1):
                    there = ring[offsets[beside] + (place + ahead) % degree]
                    if allowed[there] and not queued[there]:
                        queue[tail] = there
                        queued[there] = True
                        tail += 1
    return taken


@compiled
def _paired(order: Ints, ends: Ints, pairs: Ints, spare: Ints, used: NDArray[np.bool_]) -> Ints:
    """The edges that are removed, one after the other in the ``order (K,)``.

    An edge is removed if its two triangles ``pairs (E, 2)`` are not ``used (T,)`` yet and both ends
    have edges to ``spare (V,)``.
    """
    taken = np.empty(len(order), dtype=np.int64)
    count = 0
    for edge in order:
        first, second = pairs[edge, 0], pairs[edge, 1]
        start, end = ends[edge, 0], ends[edge, 1]
        if used[first] or used[second] or spare[start] < 1 or spare[end] < 1:
            continue
        used[first] = used[second] = True
        spare[start] -= 1
        spare[end] -= 1
        taken[count] = edge
        count += 1
    return taken[:count]


def groups(
    vertices: Floats,
    triangles: Ints,
    rank: Ints,
    on_crease: NDArray[np.bool_],
    flat: NDArray[np.bool_],
    most: float = 1.0,
) -> Ints:
    """The polygon ``(T,)`` to which each triangle will belong, as the lowest index of its
    triangles.

    ``rank (V,)`` is not 0 on creases, ``on_crease (E,)`` marks the edges of the table on creases,
    and ``flat (V,)`` marks vertices whose faces are plane. Polygons cover at most the share
    ``most`` of the area.
    """
    count = len(vertices)
    rings, table = Rings.of(triangles, count), EdgeTable.of(triangles)
    normal, area = triangle_normals(vertices, triangles)
    allowed = _mergeable(vertices, triangles, rings, rank)
    spare = rings.degrees - np.where(flat, KEPT_FLAT, KEPT)
    owner = rings.owners
    size = np.bincount(owner, area[rings.triangles], minlength=count)
    random = np.random.default_rng(0)
    best, removed = -1.0, np.zeros(count, dtype=bool)
    for _ in range(TRIALS):
        order = random.permutation(count)
        tried = _grown(rings.offsets, rings.vertices, spare, allowed, order)
        if size[tried].sum() > best:
            best, removed = size[tried].sum(), tried
    group = np.arange(len(triangles))
    inner = removed[owner]
    lowest = np.full(count, len(triangles))
    np.minimum.at(lowest, owner, rings.triangles)
    group[rings.triangles[inner]] = lowest[owner[inner]]
    used = np.zeros(len(triangles), dtype=bool)
    used[rings.triangles[inner]] = True
    spare = spare - np.bincount(rings.vertices[inner], minlength=count)
    # The triangles that are left are paired, the flattest pairs first.
    cosine = np.einsum("ij,ij->i", normal[table.triangles[:, 0]], normal[table.triangles[:, 1]])
    good = ~on_crease & (cosine > np.cos(np.radians(FOLD))) & ~used[table.triangles].any(axis=1)
    good &= _convex(vertices, table, normal)
    order = np.flatnonzero(good)
    order = order[np.argsort(-cosine[order], kind="stable")]
    edge = _paired(order, table.ends, table.triangles, spare, used)
    group[table.triangles[edge]] = table.triangles[edge].min(axis=1)[:, None]
    return _limited(group, area, most)


def _limited(group: Ints, area: Floats, most: float) -> Ints:
    """The groups without the last polygons, so that the others cover at most the share ``most``."""
    size = np.bincount(group, minlength=len(group))
    large = size[group] > 1
    covered = np.bincount(group[large], area[large], minlength=len(group))
    order = np.argsort(-size, kind="stable")
    over = np.zeros(len(group), dtype=bool)
    over[order] = np.cumsum(covered[order]) > most * area.sum()
    return np.where(over[group] & large, np.arange(len(group)), group)


def _convex(vertices: Floats, table: EdgeTable, normal: Floats) -> NDArray[np.bool_]:
    """Whether the two triangles of each edge ``(E,)`` form a strictly convex quadrilateral."""
    a, b = table.ends.T
    c, d = table.opposite.T
    axis = normal[table.triangles].sum(axis=1)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), np.finfo(float).tiny)
    ring = np.stack([a, d, b, c], axis=1)
    into = vertices[np.roll(ring, -1, axis=1)] - vertices[ring]
    out = np.roll(into, -1, axis=1)
    sine = np.einsum("ekj,ej->ek", np.cross(into, out), axis)
    sine /= np.linalg.norm(into, axis=2) * np.linalg.norm(out, axis=2)
    return np.asarray((sine > 2 * TURN).all(axis=1))


def merged(vertices: Floats, triangles: Ints, group: Ints) -> tuple[PolygonMesh, Ints]:
    """The surface with each ``group (T,)`` as one polygon, and the group of each face ``(F,)``.

    It has the same vertices. Faces with fewer corners come first. Raises ValueError if a group has
    no ring that passes each of its vertices once.
    """
    count, table = len(vertices), EdgeTable.of(triangles)
    rim = group[table.triangles[:, 0]] != group[table.triangles[:, 1]]
    (start, end), owner = table.ends[rim].T, group[table.triangles[rim]]
    owners = np.concatenate([owner[:, 0], owner[:, 1]])
    starts, ends = np.concatenate([start, end]), np.concatenate([end, start])
    key = owners * count + starts
    order = np.argsort(key, kind="stable")
    key, owners, starts = key[order], owners[order], starts[order]
    if (key[1:] == key[:-1]).any():
        raise ValueError("a polygon goes twice through a vertex")
    follows = np.searchsorted(key, owners * count + ends[order])
    face, first, degree = np.unique(owners, return_index=True, return_counts=True)
    few = np.argsort(degree, kind="stable")
    face, first, degree = face[few], first[few], degree[few]
    offsets = np.concatenate([[0], np.cumsum(degree)]).astype(np.int64)
    corners = np.full(len(key), -1)
    at = first.copy()
    for step in range(int(degree.max(initial=0))):
        going = degree > step
        corners[offsets[:-1][going] + step] = starts[at[going]]
        at[going] = follows[at[going]]
        if step and (at[going] == first[going])[degree[going] > step + 1].any():
            raise ValueError("a polygon has more than one ring")
    return PolygonMesh(vertices, offsets, corners), face
