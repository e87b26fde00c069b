"""Changes of the topology of polygon meshes: contracted edges, and rings without repeats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .graph import components
from .polygons import Ints, PolygonMesh
from .topology import edges


def reduce_rings(mesh: PolygonMesh, target: Ints) -> tuple[PolygonMesh, NDArray[np.bool_]]:
    """Replace each vertex by ``target (V,)``, and remove repeats and spikes from the rings.

    A target of -1 removes the vertex. Faces with fewer than three corners are dropped. The second
    value says which faces stay, ``(F,)``.
    """
    corners, faces = target[mesh.face_vertices], mesh.corner_faces
    corners, faces = corners[corners >= 0], faces[corners >= 0]
    while True:
        counts = np.bincount(faces, minlength=mesh.face_count)
        ends = np.cumsum(counts)
        following = np.arange(1, len(corners) + 1)
        present = counts > 0
        following[ends[present] - 1] = (ends - counts)[present]
        before = np.empty_like(following)
        before[following] = np.arange(len(corners))
        repeated = corners == corners[following]
        # Of a spike a-b-a, this pass removes b, and the next one removes the repeated a.
        spike = (corners[before] == corners[following]) & (counts[faces] > 2) & ~repeated
        spike &= ~repeated[before] & ~spike[before]
        drop = repeated | spike
        if not drop.any():
            break
        corners, faces = corners[~drop], faces[~drop]
    keep = counts >= 3
    corners = corners[keep[faces]]
    offsets = np.concatenate([[0], np.cumsum(counts[keep])]).astype(np.int64)
    return PolygonMesh(mesh.vertices, offsets, corners), keep


def contract_short_edges(
    mesh: PolygonMesh, tolerance: float, movable: NDArray[np.bool_] | None = None
) -> Ints:
    """The vertex ``(V,)`` that replaces each vertex when edges shorter than ``tolerance`` contract.

    Only edges with both ends ``movable (V,)`` contract; the default is all.
    """
    ends = edges(mesh)
    length = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    short = length < tolerance
    if movable is not None:
        short &= movable[ends].all(axis=1)
    ends = ends[short]
    count = mesh.vertex_count
    _, labels = components(count, ends)
    representative = np.full(labels.max() + 1, count, dtype=np.int64)
    np.minimum.at(representative, labels, np.arange(count))
    return np.asarray(representative[labels])
