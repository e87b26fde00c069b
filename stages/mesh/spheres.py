"""Spheres at the vertices of a surface: their first radii, and generators that may lie in them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from .geometry import face_frames
from .polygons import Floats, Ints, PolygonMesh

AT_ONCE = 20_000
"""Number of balls that are searched at once, which bounds the memory."""


def initial_spheres(mesh: PolygonMesh) -> tuple[Floats, Floats]:
    """Radii ``(V,)`` and offsets ``(F,)`` at the start of the training (paper, section 3.3).

    ``r_v`` is the mean distance of vertex v from the centroids of its faces. ``delta_f`` is the
    square root of the area of face f.
    """
    area, _, centroid = face_frames(mesh)
    reach = np.linalg.norm(mesh.vertices[mesh.face_vertices] - centroid[mesh.corner_faces], axis=1)
    total = np.bincount(mesh.face_vertices, reach, minlength=mesh.vertex_count)
    count = np.bincount(mesh.face_vertices, minlength=mesh.vertex_count)
    return total / np.maximum(count, 1), np.sqrt(area)


def held(
    points: Floats, centres: Floats, radii: Floats, threads: int
) -> Iterator[tuple[Ints, Ints]]:
    """The ``points (N, 3)`` in balls of ``radii (V,)`` about ``centres (V, 3)``: numbers of points
    and balls, ``(P,)`` each, sorted by ball, then point, of some balls at a time."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    for some in np.array_split(np.arange(len(centres)), 1 + len(centres) // AT_ONCE):
        found = tree.query_ball_point(
            centres[some], radii[some], workers=threads, return_sorted=True
        )
        count = np.fromiter((len(row) for row in found), np.int64, len(found))
        point = np.fromiter(chain.from_iterable(found), np.int64, int(count.sum()))
        yield point, np.repeat(some, count)


def without(keys: Ints, others: Ints) -> NDArray[np.bool_]:
    """Which of ``keys (N,)`` are not in ``others (M,)``, which are sorted and at least one."""
    at = np.minimum(np.searchsorted(others, keys), len(others) - 1)
    return np.asarray(others[at] != keys)


def near_pairs(
    mesh: PolygonMesh, targets: Floats, centres: Floats, radii: Floats, slack: float, threads: int
) -> tuple[Ints, Ints]:
    """Targets within ``(1 + slack) r_v`` of a sphere that is not incident to their face.

    ``targets (2F, 3)``: first the outer, then the inner target of every face. Returns indices into
    targets and spheres, ``(P,)`` each, sorted by sphere.
    """
    incident = np.sort(mesh.corner_faces * mesh.vertex_count + mesh.face_vertices)
    pairs = []
    for point, sphere in held(targets, centres, (1 + slack) * radii, threads):
        apart = without((point % mesh.face_count) * mesh.vertex_count + sphere, incident)
        pairs.append((point[apart], sphere[apart]))
    points, spheres = zip(*pairs, strict=True)
    return np.concatenate(points), np.concatenate(spheres)
