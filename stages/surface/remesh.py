"""Isotropic remeshing of closed triangle surfaces (Botsch and Kobbelt 2004), on flat arrays.

Every operation is applied at once to a set of edges whose neighbourhoods do not meet, so there is
no loop over edges; the surface stays closed and keeps its topology.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .edge_table import EdgeTable, Sized
from .geometry import vertex_normals
from .polygons import Floats, Ints

LONGEST, SHORTEST = 4 / 3, 4 / 5
"""Edges longer or shorter than these multiples of the target length are split or contracted."""
PASSES = 8
"""Rounds of independent edges in one sweep of an operation."""
LEFT_OUT = 0.4
"""Distance to the mesh, in target lengths, from which on a point of the surface is left out."""
REACH = 0.7
"""Share of the way that a vertex goes at once towards such a point."""
AGAINST = -0.3
"""Cosine of the normals below which a point is of another sheet."""
FOLDED = -0.2
"""Cosine of the normals of two triangles below which their edge is folded."""
TURN = 0.3
"""Smallest cosine by which an operation may turn a triangle."""

Project = Callable[[Floats, Floats], Floats]
"""``project(points (N, 3), normals (N, 3))``: the points of the true surface to move to."""

Length = Callable[[Floats], Floats]
"""``length(points (N, 3))``: the target edge length at each."""


def remesh(
    vertices: Floats,
    triangles: Ints,
    length: Length,
    project: Project,
    cover: tuple[Floats, Floats] | None = None,
    iterations: int = 12,
) -> tuple[Floats, Ints, Floats]:
    """A triangulation of the same closed surface with edges about ``length(points)`` long.

    ``cover``, points ``(N, 3)`` of the true surface and their normals, are reached where the mesh
    leaves them out. Returns vertices ``(W, 3)``, triangles ``(T, 3)`` and the target length at each
    vertex. Raises ValueError when the surface is not closed and manifold along its edges.
    """
    mesh = Sized(vertices.copy(), triangles.copy(), length(vertices))
    for iteration in range(iterations):
        split_long(mesh)
        contract_short(mesh)
        flip(mesh, _valence_gain)
        relax(mesh, project, min(1.0, (iteration + 1) / (0.6 * iterations)))
        if cover is not None:
            reach(mesh, *cover)
        unfold(mesh)
        mesh.length = length(mesh.vertices)
    contract_short(mesh)
    flip(mesh, delaunay_gain)
    unfold(mesh)
    return mesh.vertices, mesh.triangles, mesh.length


def split_long(mesh: Sized, factor: float = LONGEST) -> int:
    """Halve edges longer than ``factor`` target lengths; the number of halved edges."""
    done = 0
    for _ in range(PASSES):
        table = EdgeTable.of(mesh.triangles)
        excess = table.lengths(mesh.vertices) / mesh.edge_target(table.ends)
        chosen = _best_in_triangles(table, excess, excess > factor, len(mesh.triangles))
        if len(chosen) == 0:
            break
        done += len(chosen)
        a, b = table.ends[chosen].T
        c, d = table.opposite[chosen].T
        new = len(mesh.vertices) + np.arange(len(chosen))
        left, right = table.triangles[chosen].T
        triangles = mesh.triangles.copy()
        triangles[left] = np.stack([a, new, c], 1)
        triangles[right] = np.stack([b, new, d], 1)
        mesh.triangles = np.concatenate(
            [triangles, np.stack([new, b, c], 1), np.stack([new, a, d], 1)]
        )
        mesh.vertices = np.concatenate([mesh.vertices, 0.5 * (mesh.vertices[a] + mesh.vertices[b])])
        mesh.length = np.concatenate([mesh.length, 0.5 * (mesh.length[a] + mesh.length[b])])
    return done


def contract_short(mesh: Sized, factor: float = SHORTEST) -> int:
    """Contract edges shorter than ``factor`` target lengths to their midpoint, where the surface
    keeps its topology, no triangle turns over and no edge becomes too long."""
    done = 0
    refused: set[int] = set()
    for _ in range(PASSES):
        table = EdgeTable.of(mesh.triangles)
        ends, count = table.ends, len(mesh.vertices)
        ratio = table.lengths(mesh.vertices) / mesh.edge_target(ends)
        valence = np.bincount(mesh.triangles.reshape(-1), minlength=count)
        candidate = np.flatnonzero((ratio < factor) & (valence[table.opposite] > 3).all(axis=1))
        if refused:
            key = ends[candidate, 0] * count + ends[candidate, 1]
            candidate = candidate[~np.isin(key, np.fromiter(refused, np.int64))]
        candidate = candidate[_common_neighbours(ends, candidate, count) == 2]
        if len(candidate) == 0:
            break
        chosen = candidate[_apart(table, ratio, candidate, count)]
        good = _may_contract(mesh, table, chosen)
        refused |= set((ends[chosen[~good], 0] * count + ends[chosen[~good], 1]).tolist())
        chosen = chosen[good]
        done += len(chosen)
        a, b = ends[chosen].T
        mesh.vertices[a] = 0.5 * (mesh.vertices[a] + mesh.vertices[b])
        mesh.length[a] = np.minimum(mesh.length[a], mesh.length[b])
        target = np.arange(count)
        target[b] = a
        triangles = target[mesh.triangles]
        gone = (triangles == triangles[:, [1, 2, 0]]).any(axis=1)
        # Numbers stay until the end of the sweep, so that refused edges keep their key.
        mesh.triangles = triangles[~gone]
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.triangles] = True
    mesh.triangles = (np.cumsum(used) - 1)[mesh.triangles]
    mesh.vertices, mesh.length = mesh.vertices[used], mesh.length[used]
    return done


Gain = Callable[[Sized, EdgeTable], Floats]


def flip(mesh: Sized, gain: Gain, passes: int = PASSES) -> int:
    """Flip edges with a positive ``gain`` where no triangle turns over; the number of flips."""
    done = 0
    for _ in range(passes):
        table = EdgeTable.of(mesh.triangles)
        count = len(mesh.vertices)
        value = gain(mesh, table)
        valence = np.bincount(mesh.triangles.reshape(-1), minlength=count)
        wanted = (value > 0) & (valence[table.ends] > 3).all(axis=1)
        existing = np.sort(table.ends, axis=1) @ np.array([count, 1])
        new_key = np.sort(table.opposite, axis=1) @ np.array([count, 1])
        wanted &= ~np.isin(new_key, existing) & (table.opposite[:, 0] != table.opposite[:, 1])
        candidate = np.flatnonzero(wanted)
        candidate = candidate[_may_flip(mesh, table, candidate)]
        if len(candidate) == 0:
            break
        # Apart from each other: the four corners of a flip belong to no other flip of the round.
        quad = np.concatenate([table.ends[candidate], table.opposite[candidate]], axis=1)
        rank = _ranks(-value[candidate])
        claim = np.full(count, len(candidate))
        np.minimum.at(claim, quad.reshape(-1), np.repeat(rank, 4))
        chosen = candidate[(claim[quad] == rank[:, None]).all(axis=1)]
        done += len(chosen)
        a, b = table.ends[chosen].T
        c, d = table.opposite[chosen].T
        left, right = table.triangles[chosen].T
        triangles = mesh.triangles.copy()
        triangles[left] = np.stack([a, d, c], 1)
        triangles[right] = np.stack([b, c, d], 1)
        mesh.triangles = triangles
    return done


def relax(mesh: Sized, project: Project, pull: float, step: float = 0.7) -> None:
    """Move vertices along the surface towards the mean of their triangles' centroids, then onto
    the true surface. Triangles weigh by their area over the squared target length."""
    corners = mesh.vertices[mesh.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weight = np.linalg.norm(cross, axis=1) / mesh.length[mesh.triangles].mean(axis=1) ** 2
    flat = mesh.triangles.reshape(-1)
    count = len(mesh.vertices)
    total = np.bincount(flat, np.repeat(weight, 3), minlength=count)
    centroid = weight[:, None] * corners.mean(axis=1)
    mean = (
        np.stack(
            [np.bincount(flat, np.repeat(centroid[:, k], 3), minlength=count) for k in range(3)], 1
        )
        / np.maximum(total, np.finfo(float).tiny)[:, None]
    )
    normal = vertex_normals(mesh.vertices, mesh.triangles)
    move = mean - mesh.vertices
    move -= np.einsum("ij,ij->i", move, normal)[:, None] * normal
    moved = mesh.vertices + step * move
    mesh.vertices = moved + pull * (project(moved, normal) - moved)


def reach(mesh: Sized, points: Floats, normals: Floats) -> int:
    """Move vertices towards ``points (N, 3)`` of the true surface that the mesh leaves out, such as
    the tips of what is thin; the number of points left out.

    ``normals (N, 3)`` keep a vertex from being drawn to another sheet.
    """
    from scipy.spatial import cKDTree

    corners = mesh.triangles.reshape(-1)
    at = mesh.vertices[mesh.triangles]
    middles = 0.5 * (at + at[:, [1, 2, 0]])
    places = np.concatenate([mesh.vertices, at.mean(axis=1), middles.reshape(-1, 3)])
    vertex = np.concatenate([np.arange(len(mesh.vertices)), mesh.triangles[:, 0], corners])
    distance, near = cKDTree(places).query(points)
    own = vertex[near]
    own_normal = vertex_normals(mesh.vertices, mesh.triangles)[own]
    far = distance > LEFT_OUT * mesh.length[own]
    far &= np.einsum("ij,ij->i", own_normal, normals) > AGAINST
    far = np.flatnonzero(far)
    far = far[np.argsort(distance[far], kind="stable")]
    target = mesh.vertices.copy()
    target[own[far]] = points[far]  # the farthest of a vertex comes last and stays
    mesh.vertices = mesh.vertices + REACH * (target - mesh.vertices)
    return len(far)


def unfold(mesh: Sized, rounds: int = 10) -> int:
    """Move the vertices of folded edges to the mean of their neighbours until none is folded or
    ``rounds`` are over; the number of edges that still are."""
    table = EdgeTable.of(mesh.triangles)
    count = len(mesh.vertices)
    ends = np.concatenate([table.ends, table.ends[:, ::-1]])
    degree = np.bincount(ends[:, 0], minlength=count)
    for _ in range(rounds):
        corners = mesh.vertices[mesh.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
        left, right = table.triangles.T
        folded = np.einsum("ij,ij->i", normal[left], normal[right]) < FOLDED
        if not folded.any():
            return 0
        moved = np.zeros(count, dtype=bool)
        moved[table.ends[folded]] = moved[table.opposite[folded]] = True
        mean = (
            np.stack(
                [
                    np.bincount(ends[:, 0], mesh.vertices[ends[:, 1], k], minlength=count)
                    for k in range(3)
                ],
                axis=1,
            )
            / degree[:, None]
        )
        mesh.vertices[moved] = mean[moved]
    return int(folded.sum())


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


def _may_contract(mesh: Sized, table: EdgeTable, chosen: Ints) -> NDArray[np.bool_]:
    """Whether contracting turns no triangle over and leaves no edge too long."""
    count = len(mesh.vertices)
    a, b = table.ends[chosen].T
    owner = np.full(count, -1)
    owner[a], owner[b] = np.arange(len(chosen)), np.arange(len(chosen))
    middle = mesh.vertices.copy()
    middle[a] = middle[b] = 0.5 * (mesh.vertices[a] + mesh.vertices[b])
    hit = owner[mesh.triangles]
    touched = np.flatnonzero((hit >= 0).any(axis=1) & ((hit >= 0).sum(axis=1) == 1))
    which = hit[touched].max(axis=1)
    triangles = mesh.triangles[touched]
    turned = _turn(mesh.vertices, triangles, middle, triangles) < TURN
    corners = middle[triangles]
    side = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    target = mesh.length[triangles]
    target = 0.5 * (target + target[:, [1, 2, 0]])
    stretched = (side > LONGEST * target).any(axis=1)
    good = np.ones(len(chosen), dtype=bool)
    good[which[turned | stretched]] = False
    return good


def _turn(before: Floats, old: Ints, after: Floats, new: Ints) -> Floats:
    """Cosine between the normals of triangles ``old`` over before and ``new`` over after."""
    first, second = before[old], after[new]
    n1 = np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
    n2 = np.cross(second[:, 1] - second[:, 0], second[:, 2] - second[:, 0])
    size = np.linalg.norm(n1, axis=1) * np.linalg.norm(n2, axis=1)
    return np.asarray(np.einsum("ij,ij->i", n1, n2) / np.maximum(size, np.finfo(float).tiny))


def _may_flip(mesh: Sized, table: EdgeTable, candidate: Ints) -> NDArray[np.bool_]:
    a, b = table.ends[candidate].T
    c, d = table.opposite[candidate].T
    old = np.stack([a, b, c], 1), np.stack([b, a, d], 1)
    new = np.stack([a, d, c], 1), np.stack([b, c, d], 1)
    good = np.ones(len(candidate), dtype=bool)
    for one in old:
        for other in new:
            good &= _turn(mesh.vertices, one, mesh.vertices, other) > TURN
    return good


def _valence_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """By how much a flip brings the valences nearer to six."""
    valence = np.bincount(mesh.triangles.reshape(-1), minlength=len(mesh.vertices))
    ends, opposite = valence[table.ends] - 6, valence[table.opposite] - 6
    before = (ends**2).sum(axis=1) + (opposite**2).sum(axis=1)
    after = ((ends - 1) ** 2).sum(axis=1) + ((opposite + 1) ** 2).sum(axis=1)
    return np.asarray(before - after, dtype=np.float64)


def delaunay_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """Sum of the two angles opposite an edge, less pi."""
    return _opposite_angles(mesh.vertices, table) - np.pi - 1e-9


def _opposite_angles(vertices: Floats, table: EdgeTable) -> Floats:
    total = np.zeros(len(table.ends))
    for side in range(2):
        apex = vertices[table.opposite[:, side]]
        u, v = vertices[table.ends[:, 0]] - apex, vertices[table.ends[:, 1]] - apex
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        total += np.arctan2(sine, np.einsum("ij,ij->i", u, v))
    return total
