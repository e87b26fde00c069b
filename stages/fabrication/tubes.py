"""Tubes along edges. Each tube is the convex hull of the polyhedra at its two ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..mesh.edits import contract_short_edges, reduce_rings
from ..mesh.graph import components
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.topology import edges

RISE = 0.02
"""Height in mm by which a raised node is above its lower neighbour."""
FILLET_REACH, FILLET_RADIUS = 1.6, 0.8
"""Length of a fillet along a tube, and its radius at the end, in tube radii."""


@dataclass(frozen=True)
class TubeGraph:
    """The axes of tubes: ``nodes (K, 3)`` in mm, ``tubes (E, 2)``, and the faces over the nodes."""

    nodes: Floats
    tubes: Ints
    faces: PolygonMesh
    face_sources: Ints
    """The face of the surface from which each face of ``faces`` comes."""

    @property
    def lengths(self) -> Floats:
        """Lengths of the tubes ``(E,)`` in mm."""
        ends = self.nodes[self.tubes]
        return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))

    @property
    def parts(self) -> int:
        """The number of connected components."""
        return components(len(self.nodes), self.tubes)[0]

    @property
    def loops(self) -> int:
        """The number of independent cycles, E - V + components. It is the genus of thin
        tubes along the graph."""
        return len(self.tubes) - len(self.nodes) + self.parts


def tube_graph(surface: PolygonMesh, weld: float, wanted: Ints | None = None) -> TubeGraph:
    """The edges of ``surface``, in mm, after edges shorter than ``weld`` are contracted.

    ``wanted (E, 2)`` are the edges to take, by default all. Voronoi edges can be as short as a
    millionth of the size, and tubes along them would only take time. Contracted vertices go to
    their mean.
    """
    target = contract_short_edges(surface, weld)
    count = np.bincount(target, minlength=surface.vertex_count)
    placed = np.zeros_like(surface.vertices)
    for axis in range(3):
        placed[:, axis] = np.bincount(
            target, surface.vertices[:, axis], minlength=surface.vertex_count
        ) / np.maximum(count, 1)
    taken = edges(surface) if wanted is None else wanted
    ends = np.unique(np.sort(target[taken], axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    faces, kept = reduce_rings(surface.with_vertices(placed), target)
    used = np.unique(np.concatenate([ends.ravel(), faces.face_vertices]))
    renumber = np.zeros(surface.vertex_count, dtype=np.int64)
    renumber[used] = np.arange(len(used))
    return TubeGraph(
        nodes=placed[used],
        tubes=renumber[ends],
        faces=PolygonMesh(placed[used], faces.face_offsets, renumber[faces.face_vertices]),
        face_sources=np.flatnonzero(kept),
    )


def raised(graph: TubeGraph, floor: float, most: float) -> TubeGraph:
    """The graph with nodes above ``floor`` raised until each has a lower neighbour.

    Then a printer begins none of them in the air. A hollow that would have to be raised by more
    than ``most`` stays as it is.
    """
    start, end = np.concatenate([graph.tubes, graph.tubes[:, ::-1]]).T
    height, count = graph.nodes[:, 2], len(graph.nodes)
    standing = (height <= floor) | (height == height.min())
    # Hollows are filled, as by water: a node gets the lowest height from which a path leads down to
    # a node that stands.
    filled = np.where(standing, height, np.inf)
    while True:
        least = np.full(count, np.inf)
        np.minimum.at(least, start, filled[end])
        following = np.where(standing, height, np.maximum(height, least + RISE))
        if np.array_equal(following, filled):
            break
        filled = following
    lifted = np.isfinite(filled) & (filled > height)
    both = lifted[start] & lifted[end]
    _, hollow = components(count, np.stack([start[both], end[both]], axis=1))
    deepest = np.zeros(count)
    np.maximum.at(deepest, hollow[lifted], (filled - height)[lifted])
    lifted &= deepest[hollow] <= most
    nodes = graph.nodes.copy()
    nodes[lifted, 2] = filled[lifted]
    return replace(graph, nodes=nodes, faces=graph.faces.with_vertices(nodes))


def ball(sides: int) -> Floats:
    """Corners ``(P, 3)`` of a polyhedron on the unit sphere, with ``sides``
    corners around the equator."""
    from manifold3d import Manifold

    mesh = Manifold.sphere(1.0, sides).to_mesh()
    return np.asarray(mesh.vert_properties[:, :3], dtype=np.float64)


def compensation(corners: Floats) -> float:
    """Factor for the radius, so that the thinnest tube between two polyhedra has the wanted radius.

    The cross-section of a tube is the polyhedron seen along the tube. Its inner radius is at least
    the distance of the polyhedron's nearest facet from the centre.
    """
    from scipy.spatial import ConvexHull

    return float(1 / np.abs(ConvexHull(corners).equations[:, 3]).min())


def tubes(graph: TubeGraph, radii: Floats, sides: int, fillet: bool = False) -> list[Any]:
    """A convex body for each edge, in mm. ``radii (K,)`` are those at the nodes.

    Tubes share the polyhedron at their common node, so that they merge. With ``fillet``, each node
    gets the hull of its polyhedron and of smaller ones a short distance along its tubes.
    """
    from manifold3d import Manifold

    corners = ball(sides)
    corners = corners * compensation(corners)
    at = graph.nodes[:, None] + radii[:, None, None] * corners
    # manifold3d computes one hull at a time, in about 1 ms, hence these loops.
    bodies = [Manifold.hull_points(np.concatenate([at[a], at[b]])) for a, b in graph.tubes.tolist()]
    if not fillet:
        return bodies
    both = np.concatenate([graph.tubes, graph.tubes[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    start, other = both.T
    along = graph.nodes[other] - graph.nodes[start]
    length = np.linalg.norm(along, axis=1)
    reach = np.minimum(FILLET_REACH * radii[start], 0.5 * length)
    out = graph.nodes[start] + along * (reach / length)[:, None]
    small = out[:, None] + FILLET_RADIUS * radii[start][:, None, None] * corners
    first = np.searchsorted(start, np.arange(len(graph.nodes) + 1)).tolist()
    for node in np.unique(start).tolist():
        branches = small[first[node] : first[node + 1]].reshape(-1, 3)
        bodies.append(Manifold.hull_points(np.concatenate([at[node], branches])))
    return bodies


def tapered(nodes: Floats, radius: float, top: float) -> Floats:
    """The radii ``(K,)`` of nodes: ``radius`` at the lowest node, and ``top``
    times that at the highest."""
    z = nodes[:, 2]
    return np.asarray(radius * (1 - (1 - top) * (z - z.min()) / max(float(np.ptp(z)), 1e-300)))
