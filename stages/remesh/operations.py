"""Local operations on closed triangle surfaces: split, contract and flip edges.

Each operation applies to a set of edges with separate neighbourhoods at once, so that there is no
loop over edges. The surface stays closed and keeps its topology (Botsch and Kobbelt 2004).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import triangle_normals
from ..mesh.polygons import Floats, Ints

LONGEST, SHORTEST = 4 / 3, 4 / 5
"""Edges are split if they are longer than the first, and contracted if they are shorter than the
second, in target lengths."""
PASSES = 8
"""Largest number of sets of edges in one sweep of an operation."""
STRETCH = 1.05
"""Largest factor by which an operation may lengthen an edge that is too long already."""
TURN, STRICT_TURN = 0.3, 0.8
"""Smallest cosine between the normals of a triangle before and after an operation; the second
number applies where vertices keep their places."""
SLIVER = 0.04
"""A triangle with a smaller area, in squared target lengths, has no meaningful normal."""
FOLDED, OPENED = -0.5, 0.5
"""An edge is folded if the cosine between the normals of its two triangles is below the first
number, and it is not folded if the cosine is above the second."""

Gain = Callable[[Sized, EdgeTable], Floats]
"""A function that gives the gain of flipping each edge, ``(E,)``. Edges with a
gain above 0 are flipped."""


def split_long(
    mesh: Sized, factor: float = LONGEST, most: float = np.inf, passes: int = PASSES
) -> int:
    """Halve edges longer than ``factor`` target lengths, at most ``most`` of
    them. Returns the number."""
    done = 0
    for _ in range(passes):
        table = EdgeTable.of(mesh.triangles)
        excess = table.lengths(mesh.vertices) / mesh.edge_target(table.ends)
        chosen = _best_in_triangles(table, excess, excess > factor, len(mesh.triangles))
        if len(chosen) > most - done:
            chosen = chosen[np.argsort(-excess[chosen], kind="stable")[: int(most - done)]]
        if len(chosen) == 0:
            break
        done += len(chosen)
        a, b = table.ends[chosen].T
        c, d = table.opposite[chosen].T
        new = len(mesh.vertices) + np.arange(len(chosen))
        split = mesh.on_crease(table.ends[chosen])
        cut = np.sort(table.ends[chosen[split]], axis=1)
        span = np.array([len(mesh.vertices), 1])
        whole = np.sort(mesh.creases[:, :2], axis=1) @ span
        # Find the split edges that lie on creases.
        order = np.argsort(whole, kind="stable")
        row = order[np.searchsorted(whole[order], cut @ span)]
        halves = [
            np.stack([end[split], new[split], mesh.creases[row, 2]], axis=1) for end in (a, b)
        ]
        mesh.creases = np.concatenate([np.delete(mesh.creases, row, axis=0), *halves])
        mesh.rank = np.concatenate([mesh.rank, split.astype(np.int64)])
        left, right = table.triangles[chosen].T
        triangles = mesh.triangles.copy()
        triangles[left] = np.stack([a, new, c], 1)
        triangles[right] = np.stack([b, new, d], 1)
        mesh.triangles = np.concatenate(
            [triangles, np.stack([new, b, c], 1), np.stack([new, a, d], 1)]
        )
        mesh.vertices, mesh.length, mesh.carried = (
            np.concatenate([values, 0.5 * (values[a] + values[b])])
            for values in (mesh.vertices, mesh.length, mesh.carried)
        )
    return done


def contract_short(
    mesh: Sized,
    factor: float = SHORTEST,
    where: NDArray[np.bool_] | None = None,
    to_ends: bool = False,
) -> int:
    """Contract edges shorter than ``factor`` target lengths. Returns the number of edges.

    An edge contracts to its middle, or to an end, unless that would change the topology, turn a
    triangle over, or make an edge too long. ``where (V,)`` says which vertices may be ends; the
    default is all. With ``to_ends`` edges contract to an end only, so that all vertices keep their
    places.
    """
    done = 0
    refused: set[int] = set()
    for _ in range(PASSES):
        table = EdgeTable.of(mesh.triangles)
        ends, count = table.ends, len(mesh.vertices)
        ratio = table.lengths(mesh.vertices) / mesh.edge_target(ends)
        valence = np.bincount(mesh.triangles.reshape(-1), minlength=count)
        wanted = (ratio < factor) & (valence[table.opposite] > 3).all(axis=1)
        if where is not None:
            wanted &= where[ends].any(axis=1)
        wanted &= _keeps_creases(mesh, table)
        candidate = np.flatnonzero(wanted)
        if refused:
            key = ends[candidate].min(axis=1) * count + ends[candidate].max(axis=1)
            candidate = candidate[~np.isin(key, np.fromiter(refused, np.int64))]
        candidate = candidate[_common_neighbours(ends, candidate, count) == 2]
        if len(candidate) == 0:
            break
        if to_ends:
            # On a regular mesh few edges are the shortest of their neighbourhood; random factors
            # make them more.
            ratio *= np.random.default_rng(0).uniform(0.5, 1.0, len(ratio))
        chosen = candidate[_apart(table, ratio, candidate, count)]
        a, b = ends[chosen].T
        # The vertex of higher rank stays, so that vertices on creases do.
        turned = mesh.rank[a] < mesh.rank[b]
        a, b = np.where(turned, b, a), np.where(turned, a, b)
        place = mesh.vertices[a] if to_ends else 0.5 * (mesh.vertices[a] + mesh.vertices[b])
        higher = mesh.rank[a] > mesh.rank[b]
        place[higher] = mesh.vertices[a[higher]]
        # A fine input has many small triangles with correct normals: none is exempt.
        limits = (STRICT_TURN, 0.0) if to_ends else (TURN, SLIVER)
        good = _may_contract(mesh, table, chosen, place, *limits)
        for end in (b,) if to_ends else (a, b):
            left = np.flatnonzero(~good & ~higher)
            place[left] = mesh.vertices[end[left]]
            good[left] = _may_contract(mesh, table, chosen[left], place[left], *limits)
        low, high = np.minimum(a, b), np.maximum(a, b)
        refused |= set((low[~good] * count + high[~good]).tolist())
        a, b, place = a[good], b[good], place[good]
        done += len(a)
        mesh.vertices[a] = place
        mesh.length[a] = np.minimum(mesh.length[a], mesh.length[b])
        mesh.carried[a] = np.minimum(mesh.carried[a], mesh.carried[b])
        target = np.arange(count)
        target[b] = a
        mesh.creases = np.column_stack([target[mesh.creases[:, :2]], mesh.creases[:, 2]])
        mesh.creases = mesh.creases[mesh.creases[:, 0] != mesh.creases[:, 1]]
        triangles = target[mesh.triangles]
        gone = (triangles == triangles[:, [1, 2, 0]]).any(axis=1)
        # Vertices keep their numbers during a sweep, so that refused edges keep their keys.
        mesh.triangles = triangles[~gone]
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.triangles] = True
    number = np.cumsum(used) - 1
    mesh.triangles = number[mesh.triangles]
    mesh.creases = np.column_stack([number[mesh.creases[:, :2]], mesh.creases[:, 2]])
    mesh.rank = mesh.rank[used]
    mesh.vertices, mesh.length, mesh.carried = (
        values[used] for values in (mesh.vertices, mesh.length, mesh.carried)
    )
    return done


def flip(mesh: Sized, gain: Gain, passes: int = PASSES) -> int:
    """Flip edges with a positive ``gain`` if no triangle turns over.
    Returns the number of flips."""
    done = 0
    count = len(mesh.vertices)
    active = np.ones(count, dtype=bool)
    for _ in range(passes):
        table = EdgeTable.of(mesh.triangles)
        existing = np.sort(table.ends, axis=1) @ np.array([count, 1])
        # The gain of a flip changes only if one of its four corners is changed.
        corners = np.concatenate([table.ends, table.opposite], axis=1)
        table = table.rows(np.asarray(active[corners].any(axis=1)))
        value = gain(mesh, table)
        valence = np.bincount(mesh.triangles.reshape(-1), minlength=count)
        wanted = (value > 0) & (valence[table.ends] > 3).all(axis=1)
        wanted &= ~mesh.on_crease(table.ends)
        wanted &= table.opposite[:, 0] != table.opposite[:, 1]
        candidate = np.flatnonzero(wanted)
        new_key = np.sort(table.opposite[candidate], axis=1) @ np.array([count, 1])
        place = np.searchsorted(existing, new_key) % len(existing)  # edges are sorted by this key
        candidate = candidate[existing[place] != new_key]
        candidate = candidate[_may_flip(mesh, table, candidate)]
        if len(candidate) == 0:
            break
        # Flips of one round have no corners in common.
        quad = np.concatenate([table.ends[candidate], table.opposite[candidate]], axis=1)
        rank = _ranks(-value[candidate])
        claim = np.full(count, len(candidate))
        np.minimum.at(claim, quad.reshape(-1), np.repeat(rank, 4))
        chosen = candidate[(claim[quad] == rank[:, None]).all(axis=1)]
        active = claim < len(candidate)
        done += len(chosen)
        a, b = table.ends[chosen].T
        c, d = table.opposite[chosen].T
        left, right = table.triangles[chosen].T
        triangles = mesh.triangles.copy()
        triangles[left] = np.stack([a, d, c], 1)
        triangles[right] = np.stack([b, c, d], 1)
        mesh.triangles = triangles
    return done


def valence_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """The decrease of the valences' deviation from six."""
    valence = np.bincount(mesh.triangles.reshape(-1), minlength=len(mesh.vertices))
    ends, opposite = valence[table.ends] - 6, valence[table.opposite] - 6
    before = (ends**2).sum(axis=1) + (opposite**2).sum(axis=1)
    after = ((ends - 1) ** 2).sum(axis=1) + ((opposite + 1) ** 2).sum(axis=1)
    return np.asarray(before - after, dtype=np.float64)


def delaunay_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """The sum of the two angles opposite each edge, minus pi. Angles are measured in the metric."""
    total = np.full(len(table.ends), -np.pi - 1e-9)
    measure = np.eye(3)[None]
    if mesh.metric is not None:
        measure = mesh.metric(mesh.vertices[table.ends].mean(axis=1))
    for side in range(2):
        apex = mesh.vertices[table.opposite[:, side]]
        u, v = (mesh.vertices[table.ends[:, k]] - apex for k in range(2))
        uu, uv, vv = (
            np.einsum("...i,...ij,...j->...", one, measure, other)
            for one, other in ((u, u), (u, v), (v, v))
        )
        total += np.arctan2(np.sqrt(np.maximum(uu * vv - uv * uv, 0.0)), uv)
    return total


def unfolding_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """Positive for an edge that is folded, and is not after its flip."""
    before, after = fold_cosines(mesh, table)
    return np.where((before < FOLDED) & (after > OPENED), after - before, -1.0)


def fold_cosines(mesh: Sized, table: EdgeTable) -> tuple[Floats, Floats]:
    """The cosines between the normals of the two triangles of each edge,
    before and after its flip."""
    (a, b), (c, d) = table.ends.T, table.opposite.T
    before, after = (
        [triangle_normals(mesh.vertices, np.stack(corners, 1))[0] for corners in pair]
        for pair in (((a, b, c), (b, a, d)), ((a, d, c), (b, c, d)))
    )
    return np.einsum("ij,ij->i", *before), np.einsum("ij,ij->i", *after)


def _keeps_creases(mesh: Sized, table: EdgeTable) -> NDArray[np.bool_]:
    """Whether the contraction of each edge joins no two creases, and
    removes no crease or corner."""
    rank = mesh.rank[table.ends]
    on = mesh.on_crease(table.ends)
    good = (rank.min(axis=1) == 0) | (on & (rank.min(axis=1) < 2))
    # A closed crease of three edges would collapse.
    for side in range(2):
        other = table.opposite[:, side]
        around = [mesh.on_crease(np.stack([table.ends[:, k], other], axis=1)) for k in range(2)]
        good &= ~(on & around[0] & around[1])
    return np.asarray(good)


def _ranks(priority: Floats) -> Ints:
    rank = np.empty(len(priority), dtype=np.int64)
    rank[np.argsort(priority, kind="stable")] = np.arange(len(priority))
    return rank


def _best_in_triangles(
    table: EdgeTable, value: Floats, wanted: NDArray[np.bool_], count: int
) -> Ints:
    """The wanted edges that have the largest value in both of their triangles."""
    candidate = np.flatnonzero(wanted)
    rank = _ranks(-value[candidate])
    best = np.full(count, len(candidate))
    np.minimum.at(best, table.triangles[candidate].reshape(-1), np.repeat(rank, 2))
    return np.asarray(candidate[(best[table.triangles[candidate]] == rank[:, None]).all(axis=1)])


def _common_neighbours(ends: Ints, candidate: Ints, count: int) -> Ints:
    """The number of vertices that are neighbours of both ends of each candidate edge."""
    from scipy.sparse import csr_array

    both = np.concatenate([ends, ends[:, ::-1]])
    graph = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    shared = graph[ends[candidate, 0]].multiply(graph[ends[candidate, 1]])
    return np.asarray(shared.sum(axis=1)).reshape(-1).astype(np.int64)


def _apart(table: EdgeTable, value: Floats, candidate: Ints, count: int) -> NDArray[np.bool_]:
    """A set of candidate edges with separate neighbourhoods; shorter ones are chosen first."""
    rank = _ranks(value[candidate])
    ends = table.ends[candidate]
    claim = np.full(count, len(candidate))
    np.minimum.at(claim, ends.reshape(-1), np.repeat(rank, 2))
    around = claim.copy()
    np.minimum.at(around, table.ends[:, 0], claim[table.ends[:, 1]])
    np.minimum.at(around, table.ends[:, 1], claim[table.ends[:, 0]])
    corners = np.concatenate([ends, table.opposite[candidate]], axis=1)
    return np.asarray((around[corners] == rank[:, None]).all(axis=1))


def _may_contract(
    mesh: Sized, table: EdgeTable, chosen: Ints, place: Floats, turn: float, sliver: float
) -> NDArray[np.bool_]:
    """Whether each contraction to ``place`` turns no triangle over and makes no edge too long.

    A triangle turns over if the cosine between its normals before and after is below ``turn``.
    Triangles with an area below ``sliver`` squared target lengths are exempt.
    """
    count = len(mesh.vertices)
    a, b = table.ends[chosen].T
    owner = np.full(count, -1)
    owner[a], owner[b] = np.arange(len(chosen)), np.arange(len(chosen))
    moved = mesh.vertices.copy()
    moved[a] = moved[b] = place
    hit = owner[mesh.triangles]
    touched = np.flatnonzero((hit >= 0).sum(axis=1) == 1)
    which = hit[touched].max(axis=1)
    triangles = mesh.triangles[touched]
    edges = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2)
    target = mesh.edge_target(edges).reshape(-1, 3)
    now, area = triangle_normals(mesh.vertices, triangles)
    then, _ = triangle_normals(moved, triangles)
    turned = np.einsum("ij,ij->i", now, then) < turn
    turned &= area > sliver * target.mean(axis=1) ** 2
    before, after = (
        np.linalg.norm(at[triangles] - at[triangles[:, [1, 2, 0]]], axis=2)
        for at in (mesh.vertices, moved)
    )
    stretched = ((after > LONGEST * target) & (after > STRETCH * before)).any(axis=1)
    good = np.ones(len(chosen), dtype=bool)
    good[which[turned | stretched]] = False
    return good


def _may_flip(mesh: Sized, table: EdgeTable, candidate: Ints) -> NDArray[np.bool_]:
    """Whether each flip turns no triangle over."""
    (a, b), (c, d) = table.ends[candidate].T, table.opposite[candidate].T
    old, new = (
        [triangle_normals(mesh.vertices, np.stack(corners, 1)) for corners in pair]
        for pair in (((a, b, c), (b, a, d)), ((a, d, c), (b, c, d)))
    )
    cosine = np.array([[np.einsum("ij,ij->i", one, other) for other, _ in new] for one, _ in old])
    plain = (cosine > TURN).all(axis=(0, 1))
    # In a folded pair, the normal of the larger triangle is taken as correct.
    folded = np.einsum("ij,ij->i", old[0][0], old[1][0]) < FOLDED
    larger = np.where(old[0][1] > old[1][1], cosine[0].min(axis=0), cosine[1].min(axis=0))
    return np.asarray(plain | (folded & (larger > TURN)))
