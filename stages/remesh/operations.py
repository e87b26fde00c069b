"""Local operations on closed triangle surfaces, on flat arrays.

Every operation is applied at once to a set of edges whose neighbourhoods do not meet, so there is
no loop over edges; the surface stays closed and keeps its topology (Botsch and Kobbelt 2004).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import triangle_normals
from ..mesh.polygons import Floats, Ints

LONGEST, SHORTEST = 4 / 3, 4 / 5
"""Edges longer or shorter than these multiples of the target length are split or contracted."""
PASSES = 8
"""Rounds of independent edges in one sweep of an operation."""
STRETCH = 1.05
"""Factor by which an edge that is too long already may become longer."""
TURN, STRICT_TURN = 0.3, 0.8
"""Smallest cosine by which an operation may turn a triangle, and where vertices stay in place."""
SLIVER = 0.04
"""Area, in squared target lengths, below which the normal of a triangle means nothing."""
FOLDED, OPENED = -0.5, 0.5
"""Cosine of the normals of two triangles from which on their edge is folded, or is not."""

Gain = Callable[[Sized, EdgeTable], Floats]
"""What flipping each edge is worth, ``(E,)``; those with a positive gain are flipped."""


def split_long(
    mesh: Sized, factor: float = LONGEST, most: float = np.inf, passes: int = PASSES
) -> int:
    """Halve edges longer than ``factor`` target lengths, ``most`` of them at the most; returns how
    many were."""
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
        # Each edge that is cut, among the edges on creases.
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
    """Contract edges shorter than ``factor`` target lengths to their middle or to an end, where
    the surface keeps its topology, no triangle turns over and no edge becomes too long.

    ``where (V,)`` says which vertices may be ends (default: all). With ``to_ends`` no edge is
    contracted to its middle, so that all vertices stay where they are. Returns the number of edges.
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
            # On a regular mesh the shortest of each neighbourhood are few.
            ratio *= np.random.default_rng(0).uniform(0.5, 1.0, len(ratio))
        chosen = candidate[_apart(table, ratio, candidate, count)]
        a, b = ends[chosen].T
        # What is on a crease stays there.
        turned = mesh.rank[a] < mesh.rank[b]
        a, b = np.where(turned, b, a), np.where(turned, a, b)
        place = mesh.vertices[a] if to_ends else 0.5 * (mesh.vertices[a] + mesh.vertices[b])
        higher = mesh.rank[a] > mesh.rank[b]
        place[higher] = mesh.vertices[a[higher]]
        # Most triangles of a fine input are small, and their normals are right.
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
        # Numbers stay until the end of the sweep, so that refused edges keep their key.
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
    """Flip edges with a positive ``gain`` where no triangle turns over; the number of flips."""
    done = 0
    count = len(mesh.vertices)
    active = np.ones(count, dtype=bool)
    for _ in range(passes):
        table = EdgeTable.of(mesh.triangles)
        existing = np.sort(table.ends, axis=1) @ np.array([count, 1])
        # What a flip is worth changes only with what happens at its four corners.
        corners = np.concatenate([table.ends, table.opposite], axis=1)
        table = table.rows(np.asarray(active[corners].any(axis=1)))
        value = gain(mesh, table)
        valence = np.bincount(mesh.triangles.reshape(-1), minlength=count)
        wanted = (value > 0) & (valence[table.ends] > 3).all(axis=1)
        wanted &= ~mesh.on_crease(table.ends)
        wanted &= table.opposite[:, 0] != table.opposite[:, 1]
        candidate = np.flatnonzero(wanted)
        new_key = np.sort(table.opposite[candidate], axis=1) @ np.array([count, 1])
        place = np.searchsorted(existing, new_key) % len(existing)  # the edges are in that order
        candidate = candidate[existing[place] != new_key]
        candidate = candidate[_may_flip(mesh, table, candidate)]
        if len(candidate) == 0:
            break
        # Apart from each other: the four corners of a flip belong to no other flip of the round.
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
    """By how much a flip brings the valences nearer to six."""
    valence = np.bincount(mesh.triangles.reshape(-1), minlength=len(mesh.vertices))
    ends, opposite = valence[table.ends] - 6, valence[table.opposite] - 6
    before = (ends**2).sum(axis=1) + (opposite**2).sum(axis=1)
    after = ((ends - 1) ** 2).sum(axis=1) + ((opposite + 1) ** 2).sum(axis=1)
    return np.asarray(before - after, dtype=np.float64)


def delaunay_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """Sum of the two angles opposite an edge, in the metric if there is one, less pi."""
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
    """Positive where an edge is folded and is not after its flip."""
    before, after = fold_cosines(mesh, table)
    return np.where((before < FOLDED) & (after > OPENED), after - before, -1.0)


def fold_cosines(mesh: Sized, table: EdgeTable) -> tuple[Floats, Floats]:
    """Cosines between the normals of the two triangles of each edge, now and after its flip."""
    (a, b), (c, d) = table.ends.T, table.opposite.T
    before, after = (
        [triangle_normals(mesh.vertices, np.stack(corners, 1))[0] for corners in pair]
        for pair in (((a, b, c), (b, a, d)), ((a, d, c), (b, c, d)))
    )
    return np.einsum("ij,ij->i", *before), np.einsum("ij,ij->i", *after)


def _keeps_creases(mesh: Sized, table: EdgeTable) -> NDArray[np.bool_]:
    """Which edges may be contracted without joining two creases, or losing one or a corner."""
    rank = mesh.rank[table.ends]
    on = mesh.on_crease(table.ends)
    good = (rank.min(axis=1) == 0) | (on & (rank.min(axis=1) < 2))
    # A crease of three edges around a triangle would collapse onto itself.
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
    """Wanted edges of the largest value in both of their triangles."""
    candidate = np.flatnonzero(wanted)
    rank = _ranks(-value[candidate])
    best = np.full(count, len(candidate))
    np.minimum.at(best, table.triangles[candidate].reshape(-1), np.repeat(rank, 2))
    return np.asarray(candidate[(best[table.triangles[candidate]] == rank[:, None]).all(axis=1)])


def _common_neighbours(ends: Ints, candidate: Ints, count: int) -> Ints:
    """How many vertices are neighbours of both ends of each candidate edge."""
    from scipy.sparse import csr_array

    both = np.concatenate([ends, ends[:, ::-1]])
    graph = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    shared = graph[ends[candidate, 0]].multiply(graph[ends[candidate, 1]])
    return np.asarray(shared.sum(axis=1)).reshape(-1).astype(np.int64)


def _apart(table: EdgeTable, value: Floats, candidate: Ints, count: int) -> NDArray[np.bool_]:
    """A set of candidate edges of which no two touch or neighbour each other, shortest first."""
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
    """Whether contracting to ``place`` turns no triangle to a cosine below ``turn``, but those
    whose area is below ``sliver`` squared target lengths, and leaves no edge too long."""
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
    (a, b), (c, d) = table.ends[candidate].T, table.opposite[candidate].T
    old, new = (
        [triangle_normals(mesh.vertices, np.stack(corners, 1)) for corners in pair]
        for pair in (((a, b, c), (b, a, d)), ((a, d, c), (b, c, d)))
    )
    cosine = np.array([[np.einsum("ij,ij->i", one, other) for other, _ in new] for one, _ in old])
    plain = (cosine > TURN).all(axis=(0, 1))
    # Of a folded pair the larger triangle says which way is up.
    folded = np.einsum("ij,ij->i", old[0][0], old[1][0]) < FOLDED
    larger = np.where(old[0][1] > old[1][1], cosine[0].min(axis=0), cosine[1].min(axis=0))
    return np.asarray(plain | (folded & (larger > TURN)))
