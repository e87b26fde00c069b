"""Creases of the true surface, and the edges of a triangulation that lie on them.

A vertex has a rank: it is free, on a crease, or at a corner, where creases end.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from .edge_table import EdgeTable, Sized
from .geometry import triangle_normals
from .polygons import Floats, Ints

FREE, CREASE, CORNER = 0, 1, 2
"""The ranks of vertices."""
NEAR = 1.0
"""Largest distance between a vertex and the crease that it is moved to, in target lengths."""
DETOUR = 50.0
"""Weight in the cost of an edge of its squared distance from the crease, in target lengths."""
PARTS = 64
"""Number of points of an edge at which its distance from a crease is measured."""
DENSE = 0.1
"""Distance between the sample points of a crease, in units of h0."""
FLAT = 0.01
"""A triangle counts as flat if its height divided by its longest edge is less."""
EAR = 0.5
"""A triangle with two edges on a crease is an ear if its height, in target lengths, is less."""
APART = 1e5
"""Distance in units of h0 by which chains are separated in a fourth dimension, so that one tree
finds the closest point of a given chain. It is larger than any shape."""


@dataclass(frozen=True)
class Chain:
    """A crease between two corners, or a closed crease. ``points (N, 3)`` are in order."""

    points: Floats
    closed: bool

    @property
    def length(self) -> float:
        """Length of the chain, in the unit of its points."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


class Creases:
    """The creases of a surface, in model units."""

    def __init__(self, chains: list[Chain]) -> None:
        from scipy.spatial import cKDTree

        self.chains = chains
        starts = np.concatenate([chain.points[:-1] for chain in chains])
        ways = np.concatenate([np.diff(chain.points, axis=0) for chain in chains])
        self.starts, self.ways = starts, ways
        length = np.linalg.norm(ways, axis=1)
        count = np.maximum(1, np.ceil(length / DENSE)).astype(int)
        self.owner = np.repeat(np.arange(len(ways)), count)
        first = np.repeat(np.cumsum(count) - count, count)
        part = (np.arange(len(self.owner)) - first + 0.5) / count[self.owner]
        self.dense = starts[self.owner] + part[:, None] * ways[self.owner]
        self.chain = np.repeat(
            np.arange(len(chains)), [len(chain.points) - 1 for chain in chains]
        )[self.owner]  # fmt: skip
        """The chain of each of the ``dense`` points."""
        self.tangents = (ways / length[:, None])[self.owner]
        self.tree: Any = cKDTree(self.dense)
        self.trees: Any = cKDTree(np.column_stack([self.dense, APART * self.chain]))

    def closest(self, at: Floats, chain: Ints | None = None) -> tuple[Floats, Floats]:
        """The closest points ``(N, 3)`` on the creases to ``at (N, 3)``, and the unit tangents
        there.

        With ``chain (N,)``, each point is sought on the chain with that number only.
        """
        near = [k + 1 for k in range(min(4, len(self.owner)))]
        if chain is None:
            _, found = self.tree.query(at, near)
        else:
            _, found = self.trees.query(np.column_stack([at, APART * chain]), near)
            # A chain may have fewer points than are sought; its nearest one replaces the others.
            found = np.where(self.chain[found] == chain[:, None], found, found[:, :1])
        best, foot, way = np.full(len(at), np.inf), np.zeros_like(at), np.zeros_like(at)
        for column in range(found.shape[1]):
            segment = self.owner[found[:, column]]
            along = self.ways[segment]
            square = np.einsum("ij,ij->i", along, along)
            share = np.einsum("ij,ij->i", at - self.starts[segment], along) / square
            place = self.starts[segment] + np.clip(share, 0, 1)[:, None] * along
            distance = ((at - place) ** 2).sum(axis=1)
            nearer = distance < best
            best[nearer], foot[nearer] = distance[nearer], place[nearer]
            way[nearer] = (along / np.sqrt(square)[:, None])[nearer]
        return foot, way

    @property
    def corners(self) -> Floats:
        """The ends ``(C, 3)`` of all open chains, each once."""
        ends = [chain.points[[0, -1]] for chain in self.chains if not chain.closed]
        return np.unique(np.concatenate(ends), axis=0) if ends else np.zeros((0, 3))


def drawn_on(mesh: Sized, creases: Creases) -> None:
    """Move the vertices on creases to the closest points of their chains. Corners stay."""
    row = np.flatnonzero(mesh.rank == CREASE)
    mesh.vertices = mesh.vertices.copy()
    mesh.vertices[row] = creases.closest(mesh.vertices[row], mesh.chains()[row])[0]


def cut_ears(mesh: Sized) -> int:
    """Replace the two crease edges of each ear by its third edge; return the number of ears.

    An ear is a triangle with two edges on one crease. Where the crease is straight, an ear would
    have no area.
    """
    done = 0
    while len(mesh.creases):
        corners = mesh.triangles
        on = np.stack([mesh.on_crease(corners[:, [k, (k + 1) % 3]]) for k in range(3)], axis=1)
        row = np.flatnonzero(on.sum(axis=1) == 2)
        # The tip is opposite the edge that is on no crease.
        off = (~on[row]).argmax(axis=1)
        tip = corners[row, (off + 2) % 3]
        base = mesh.vertices[corners[row, (off + 1) % 3]] - mesh.vertices[corners[row, off]]
        side = mesh.vertices[tip] - mesh.vertices[corners[row, off]]
        reach = np.maximum(np.linalg.norm(base, axis=1), np.finfo(float).tiny)
        height = np.linalg.norm(np.cross(base, side), axis=1) / reach
        ear = (mesh.rank[tip] == CREASE) & (height < EAR * mesh.length[tip])
        row, off, tip = (values[ear] for values in (row, off, tip))
        # Ears that share a vertex are cut one at a time.
        first = np.full(len(mesh.vertices), len(row))
        np.minimum.at(first, corners[row].reshape(-1), np.repeat(np.arange(len(row)), 3))
        alone = (first[corners[row]] == np.arange(len(row))[:, None]).all(axis=1)
        row, off, tip = row[alone], off[alone], tip[alone]
        if len(row) == 0:
            break
        number = mesh.chains()[tip]
        kept = mesh.creases[~np.isin(mesh.creases[:, :2], tip).any(axis=1)]
        ends = corners[row, off], corners[row, (off + 1) % 3]
        mesh.creases = np.concatenate([kept, np.stack([*ends, number], axis=1)])
        mesh.rank = mesh.rank.copy()
        mesh.rank[tip] = FREE
        done += len(row)
    return done


def give_up_flat(mesh: Sized) -> int:
    """Free the crease vertices of flat triangles whose corners all lie on creases.

    No other edit gives such triangles an area. Returns the number of these triangles.
    """
    flat = (_heights(mesh) < FLAT) & (mesh.rank[mesh.triangles] > FREE).all(axis=1)
    freed = np.unique(mesh.triangles[flat])
    give_up(mesh, freed[mesh.rank[freed] == CREASE])
    return int(flat.sum())


def give_up(mesh: Sized, freed: Ints) -> None:
    """Remove the vertices ``freed (K,)``, and the edges at them, from the creases."""
    mesh.rank = mesh.rank.copy()
    mesh.rank[freed] = FREE
    mesh.creases = mesh.creases[~np.isin(mesh.creases[:, :2], freed).any(axis=1)]
    mesh.rank[(mesh.rank == CREASE) & (mesh.chains() < 0)] = FREE


def _heights(mesh: Sized) -> Floats:
    """The least height of each triangle, divided by its longest edge, ``(T,)``."""
    corners = mesh.vertices[mesh.triangles]
    _, area = triangle_normals(mesh.vertices, mesh.triangles)
    longest = ((corners - corners[:, [1, 2, 0]]) ** 2).sum(axis=2).max(axis=1)
    return np.asarray(2 * area / np.maximum(longest, np.finfo(float).tiny))


def embed(mesh: Sized, creases: Creases) -> int:
    """Find a path along edges of ``mesh`` for each crease, mark it, and move its vertices there.

    Returns the number of chains without such a path.
    """
    from scipy.spatial import cKDTree

    table = EdgeTable.of(mesh.triangles)
    count = len(mesh.vertices)
    rank, found = np.zeros(count, dtype=np.int64), []
    place = mesh.vertices.copy()
    tree: Any = cKDTree(mesh.vertices)
    corner_of: dict[tuple[float, ...], int] = {}
    for corner in creases.corners:
        distance, near = tree.query(corner, 6)
        near = [v for d, v in zip(distance, near, strict=True)
                if rank[v] == FREE and d < NEAR * mesh.length[v]]  # fmt: skip
        if near:
            rank[near[0]], place[near[0]] = CORNER, corner
            corner_of[tuple(corner)] = near[0]
    missed = 0
    lengths = table.lengths(mesh.vertices)
    target = mesh.edge_target(table.ends)
    middle = mesh.vertices[table.ends].mean(axis=1)
    reach = NEAR * target.max(initial=0.0)
    for number in np.argsort([chain.length for chain in creases.chains], kind="stable"):
        chain = creases.chains[number]
        own = Creases([chain])
        low, high = chain.points.min(axis=0) - reach, chain.points.max(axis=0) + reach
        around = np.flatnonzero(((middle >= low) & (middle <= high)).all(axis=1))
        ends = table.ends[around]
        far = np.stack(
            [np.linalg.norm(at - own.closest(at)[0], axis=1) for at in
             (middle[around], mesh.vertices[ends[:, 0]], mesh.vertices[ends[:, 1]])], 1
        ) / target[around, None]  # fmt: skip
        if chain.closed:
            third = len(chain.points) // 3
            stops = [int(tree.query(chain.points[k * third])[1]) for k in range(3)]
            stops.append(stops[0])
        else:
            tips = [corner_of.get(tuple(chain.points[k])) for k in (0, -1)]
            if None in tips or tips[0] == tips[1]:
                missed += 1
                continue
            stops = [int(tip) for tip in tips if tip is not None]
        usable = (far < NEAR).all(axis=1)
        cost = lengths[around] * (1 + DETOUR * (far**2).mean(axis=1))
        way = _way(ends[usable], cost[usable], stops, rank)
        if not way:
            missed += 1
            continue
        rank[way] = np.maximum(rank[way], CREASE)
        found += [(start, end, number) for start, end in pairwise(way)]
    mesh.rank = rank
    mesh.creases = np.array(found, dtype=np.int64).reshape(-1, 3)
    mesh.vertices = place
    drawn_on(mesh, creases)
    return missed


def _way(ends: Ints, cost: Floats, stops: list[int], rank: Ints) -> list[int]:
    """The path of least cost along edges ``ends (E, 2)`` through all ``stops`` in order.

    It meets no vertex twice, and no vertex that already lies on a crease. It is empty if there is
    none.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    way, blocked = [stops[0]], rank != FREE
    blocked[stops] = True
    for start, end in pairwise(stops):
        blocked[[start, end]] = False
        row = np.flatnonzero(~blocked[ends].any(axis=1))
        graph = csr_array((cost[row], tuple(ends[row].T)), shape=(len(rank), len(rank)))
        _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        if before[end] < 0:
            return []
        steps = [end]
        while steps[-1] != start:
            steps.append(int(before[steps[-1]]))
        way += steps[-2::-1]
        blocked[steps] = True
    return way


def deviation(creases: Creases, vertices: Floats, rank: Ints, edges: Ints) -> dict[str, float]:
    """Distances between the creases and the ``edges (K, 3)`` on them, in units of h0.

    They are measured both ways: from vertices and edges to the creases, and from these to the
    edges.
    """
    from scipy.spatial import cKDTree

    on = vertices[rank > FREE]
    if len(edges) == 0:
        return {}
    off = np.linalg.norm(on - creases.closest(on)[0], axis=1)
    parts = np.linspace(0, 1, PARTS)[:, None, None]
    along = ((1 - parts) * vertices[edges[:, 0]] + parts * vertices[edges[:, 1]]).reshape(-1, 3)
    edge_off = np.linalg.norm(along - creases.closest(along)[0], axis=1)
    away = cKDTree(along).query(creases.dense)[0]
    return {
        "vertices": len(on),
        "vertex_distance_max": float(off.max()),
        "edge_distance_max": float(edge_off.max()),
        "distance_to_edges_median": float(np.median(away)),
        "distance_to_edges_p99": float(np.percentile(away, 99)),
    }
