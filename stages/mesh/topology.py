"""Edges, neighbours, components, closedness and Euler number of polygon meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .graph import components
from .polygons import Ints, PolygonMesh


def edge_keys(mesh: PolygonMesh) -> tuple[Ints, NDArray[np.bool_]]:
    """The undirected edge from each corner to the next one, as one integer, and whether it goes
    from the smaller to the larger index."""
    start, end = mesh.face_vertices, mesh.next_vertices
    keys = np.minimum(start, end) * mesh.vertex_count + np.maximum(start, end)
    return keys, start < end


def edges(mesh: PolygonMesh) -> Ints:
    """The undirected edges ``(E, 2)``, sorted, with the smaller index first."""
    keys = np.unique(edge_keys(mesh)[0])
    return np.stack(np.divmod(keys, max(mesh.vertex_count, 1)), axis=1)


OPEN, CROWDED, TURNED = 1, 2, 3
"""Faults of an edge. OPEN: it is in one face only. CROWDED: it is in more than two faces, or joins
a vertex to itself. TURNED: it is in two faces that have it in the same direction."""


def edge_faults(mesh: PolygonMesh) -> tuple[Ints, Ints]:
    """The undirected edges ``(E, 2)``, and the fault of each ``(E,)``, 0 for none."""
    keys, forward = edge_keys(mesh)
    unique, inverse = np.unique(keys, return_inverse=True)
    uses = np.bincount(inverse, minlength=len(unique))
    ahead = np.bincount(inverse, forward, minlength=len(unique))
    fault = np.where(ahead == 1, 0, TURNED)
    fault[uses == 1] = OPEN
    fault[uses > 2] = CROWDED
    fault[inverse[mesh.face_vertices == mesh.next_vertices]] = CROWDED
    return np.stack(np.divmod(unique, max(mesh.vertex_count, 1)), axis=1), fault


def bad_edges(mesh: PolygonMesh) -> Ints:
    """The edges ``(B, 2)`` that are not in exactly two faces with opposite directions."""
    found, fault = edge_faults(mesh)
    return found[fault > 0]


def face_neighbours(mesh: PolygonMesh) -> Ints:
    """The pairs of faces that share an edge, in both orders, ``(P, 2)``."""
    keys, _ = edge_keys(mesh)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    left, right = mesh.corner_faces[order[same]], mesh.corner_faces[order[same + 1]]
    return np.concatenate([np.stack([left, right], 1), np.stack([right, left], 1)])


def face_components(mesh: PolygonMesh) -> tuple[int, Ints]:
    """The number of components that share edges, and the component of each face ``(F,)``."""
    return components(mesh.face_count, face_neighbours(mesh))


def corner_fans(mesh: PolygonMesh) -> tuple[int, Ints]:
    """The number of fans, and the fan of each corner ``(sum,)``.

    A fan is a set of faces around a vertex in which each is reached from the others across edges.
    """
    # In this graph the nodes are corners. Two are joined if they are at the same vertex, on the two
    # sides of an edge. Each connected component is a fan.
    count = len(mesh.face_vertices)
    corner = np.arange(count)
    keys, _ = edge_keys(mesh)
    half_key = np.concatenate([keys, keys]) * 2
    at_start = mesh.face_vertices < mesh.next_vertices
    half_key[:count] += ~at_start
    half_key[count:] += at_start
    half_corner = np.concatenate([corner, mesh.next_corners])
    order = np.argsort(half_key, kind="stable")
    ordered = half_key[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    rows, columns = half_corner[order[same]], half_corner[order[same + 1]]
    return components(count, np.stack([rows, columns], axis=1))


def pinched_vertices(mesh: PolygonMesh) -> Ints:
    """The vertices whose faces do not form one fan."""
    _, group = corner_fans(mesh)
    pairs = np.unique(np.stack([mesh.face_vertices, group], axis=1), axis=0)
    fans = np.bincount(pairs[:, 0], minlength=mesh.vertex_count)
    return np.flatnonzero(fans > 1)


def split_pinched(mesh: PolygonMesh) -> PolygonMesh:
    """The same faces with a copy of the vertex for each fan, and without unused vertices."""
    fans, group = corner_fans(mesh)
    vertex = np.zeros(fans, dtype=np.int64)
    vertex[group] = mesh.face_vertices
    return PolygonMesh(mesh.vertices[vertex], mesh.face_offsets, group)


@dataclass(frozen=True)
class Topology:
    """Counts that describe a surface. ``closed`` and ``euler_number`` follow from them."""

    vertices: int
    edges: int
    faces: int
    euler_number: int
    components: int
    bad_edges: int
    pinched_vertices: int

    @property
    def closed(self) -> bool:
        """Whether each edge is in exactly two faces, with opposite directions."""
        return self.faces > 0 and self.bad_edges == 0


def topology(mesh: PolygonMesh) -> Topology:
    """The topology of ``mesh``. Vertices that no face uses are not counted.

    The Euler number is V - E + F: 2 for a sphere, 0 for a torus.
    """
    vertex_count = len(np.unique(mesh.face_vertices))
    edge_count = len(edges(mesh))
    return Topology(
        vertices=vertex_count,
        edges=edge_count,
        faces=mesh.face_count,
        euler_number=vertex_count - edge_count + mesh.face_count,
        components=face_components(mesh)[0] if mesh.face_count else 0,
        bad_edges=len(bad_edges(mesh)),
        pinched_vertices=len(pinched_vertices(mesh)) if mesh.face_count else 0,
    )
