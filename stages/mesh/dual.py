"""The dual of a closed surface: each vertex becomes a polygon, each face a corner."""

from __future__ import annotations

import numpy as np

from .geometry import face_frames
from .polygons import PolygonMesh


def dual(mesh: PolygonMesh) -> PolygonMesh:
    """The polygons that join the centroids of the faces around each vertex of ``mesh``, in order.

    Face v belongs to vertex v; vertices that no face uses have no polygon. Raises ValueError if the
    surface is not closed, or if the faces at a vertex do not form one fan.
    """
    _, _, centroid = face_frames(mesh)
    count = mesh.vertex_count
    start, end, face = mesh.face_vertices, mesh.next_vertices, mesh.corner_faces
    # Around a vertex v the face after f, counter-clockwise, has f's edge that ends in v.
    leaving = start * count + end
    order = np.argsort(leaving)
    arriving = np.searchsorted(leaving[order], end * count + start)
    if (arriving >= len(order)).any() or (
        leaving[order[np.minimum(arriving, len(order) - 1)]] != end * count + start
    ).any():
        raise ValueError("the surface is not closed")
    # Half-edge (v -> w) of f: its twin (w -> v) lies in the next face clockwise around v, whose
    # own half-edge from v follows the twin in its ring.
    twin = order[arriving]
    clockwise = mesh.next_corners[twin]
    corner = np.full(count, -1, dtype=np.int64)
    corner[start] = np.arange(len(start))
    used = np.flatnonzero(corner >= 0)
    valence = np.bincount(start, minlength=count)[used]
    offsets = np.concatenate([[0], np.cumsum(valence)]).astype(np.int64)
    rings = np.empty(offsets[-1], dtype=np.int64)
    here = corner[used]
    for step in range(int(valence.max(initial=0))):
        more = valence > step
        rings[offsets[1:][more] - 1 - step] = face[here[more]]
        here = clockwise[here]
        # In one fan the start is met again after as many steps as there are faces, no sooner.
        if ((here == corner[used]) != (valence == step + 1))[more].any():
            raise ValueError("the faces at a vertex are not one fan")
    return PolygonMesh(centroid, offsets, rings)
