"""Closed parts of a mesh that touch or cross each other: taken apart, or united."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..surface.geometry import enclosed_volume, fan_triangles
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.topology import bad_edges, split_pinched
from .parity import RayParity

SAME = 9
"""Digits of an angle to which faces lie on each other."""


def united(mesh: PolygonMesh) -> tuple[PolygonMesh, int] | None:
    """The union of the closed parts of ``mesh``, whose edges are all in two faces, and how many of
    them cross another; None where none does, or no solid can be made of one.

    A part that is turned inside out is a cavity where it lies within another that it does not
    cross; elsewhere it is taken the right way round.
    """
    vertices, triangles = fan_triangles(mesh)[:2]
    mesh = split_pinched(PolygonMesh.of_triangles(vertices, triangles))
    vertices, triangles = fan_triangles(mesh)[:2]
    part = _parts(triangles, len(vertices))
    count = int(part.max()) + 1
    if count == 1 or not _boxes_meet(vertices, part):
        return None
    from ..metrics.intersections import self_intersections  # what it compiles with is large

    pairs = part[triangles[self_intersections(vertices, triangles), 0]]
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    if len(pairs) == 0:
        return None
    from manifold3d import Manifold, OpType

    shells = [triangles[part[triangles[:, 0]] == number] for number in range(count)]
    volume = np.array([enclosed_volume(vertices, shell) for shell in shells])
    solids = [
        _solid(vertices, shell if outward else shell[:, ::-1])
        for shell, outward in zip(shells, volume > 0, strict=True)
    ]
    if any(solid.status().name != "NoError" for solid in solids):
        return None
    bodies = [solid for solid, outward in zip(solids, volume > 0, strict=True) if outward]
    outer = np.flatnonzero(volume > 0)
    outer = outer[np.argsort(volume[outer])]
    for number in np.flatnonzero(volume <= 0):
        crossed = pairs[(pairs == number).any(axis=1)].reshape(-1)
        tip = vertices[shells[number][0, 0]][None]
        for around in outer[~np.isin(outer, crossed)]:
            if RayParity(vertices, shells[around]).inside(tip)[0]:
                at = int(np.flatnonzero(np.flatnonzero(volume > 0) == around)[0])
                bodies[at] = bodies[at] - solids[number]
                break
        else:
            bodies.append(solids[number])
    found = Manifold.batch_boolean(bodies, OpType.Add).to_mesh64()
    result = PolygonMesh.of_triangles(
        np.asarray(found.vert_properties)[:, :3].copy(), np.asarray(found.tri_verts, np.int64)
    )
    if result.face_count == 0 or len(bad_edges(result)):
        return None
    return result, len(np.unique(pairs))


def parted(mesh: PolygonMesh) -> tuple[PolygonMesh, int] | None:
    """The triangles of a ``mesh`` that is not closed, because its parts touch, as a closed one, and
    how many faces are left out; None where it is open otherwise.

    Faces that are there twice count once, and those that face each other not at all: two solids
    with a common face are one. At other edges of more than two faces, as where two solids touch
    along an edge, those two belong together that have a solid between them.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices, triangles = fan_triangles(mesh)[:2]
    order = np.argsort(triangles, axis=1)
    # The sign of the permutation that sorts three corners.
    sign = np.where((order[:, 1] - order[:, 0]) % 3 == 1, 1, -1)
    same = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    total = np.bincount(same, sign)
    # Of each group one that faces as most of it does.
    agreeing = np.flatnonzero(sign == np.sign(total[same]))
    kept = np.unique(agreeing[np.unique(same[agreeing], return_index=True)[1]])
    left_out = len(triangles) - len(kept)
    triangles = triangles[kept]
    corner = np.arange(triangles.size)
    start, following = triangles.reshape(-1), np.roll(corner.reshape(-1, 3), -1, axis=1).reshape(-1)
    one, other = _sides(vertices, triangles)
    # The two faces of an edge share the corners at both of its ends.
    ends = np.concatenate(
        [np.stack([one, following[other]], 1), np.stack([following[one], other], 1)]
    )
    graph = coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(len(corner),) * 2)
    count, group = connected_components(graph, directed=False)
    at = np.zeros(count, dtype=np.int64)
    at[group] = start
    result = PolygonMesh.of_triangles(vertices[at], group.reshape(-1, 3).astype(np.int64))
    if result.face_count == 0 or len(bad_edges(result)):
        return None
    return result, left_out


def _sides(vertices: Floats, triangles: Ints) -> tuple[Ints, Ints]:
    """Half-edges (of the corners that they start from) that belong to one edge: one that goes up,
    the other down. Of more than two around an edge each that goes up has its own solid on the
    clockwise side, up to one that goes down."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    third = np.roll(triangles, 1, axis=1).reshape(-1)
    up = start < end
    low, high = np.where(up, start, end), np.where(up, end, start)
    key = low * len(vertices) + high
    axis = vertices[high] - vertices[low]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), np.finfo(float).tiny)
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    away = vertices[third] - vertices[low]
    angle = np.arctan2(
        np.einsum("ij,ij->i", np.cross(axis, first), away), np.einsum("ij,ij->i", first, away)
    )
    # Where two faces lie on each other the solid below comes to its end before the next begins.
    order = np.lexsort((~up, angle.round(SAME), key))
    _, begin, uses = np.unique(key[order], return_index=True, return_counts=True)
    before = np.arange(len(order)) - 1
    before[begin] = begin + uses - 1
    one, other = order, order[before]
    fitting = up[one] & ~up[other]
    return one[fitting], other[fitting]


def _parts(triangles: Ints, count: int) -> Ints:
    """The connected part ``(V,)`` of each of ``count`` vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _boxes_meet(vertices: Floats, part: Ints) -> bool:
    """Whether the bounding boxes of two parts have a point in common."""
    count = int(part.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, vertices)
    np.maximum.at(high, part, vertices)
    # Sorted along an axis, a box can only meet those that begin before it ends.
    order = np.argsort(low[:, 0])
    last = np.searchsorted(low[order, 0], high[order, 0], side="right")
    for number, end in enumerate(last):
        at, others = order[number], order[number + 1 : end]
        meets = (low[others] <= high[at]).all(axis=1) & (high[others] >= low[at]).all(axis=1)
        if meets.any():
            return True
    return False


def _solid(vertices: Floats, triangles: Ints) -> Any:
    from manifold3d import Manifold, Mesh64

    used, corners = np.unique(triangles, return_inverse=True)
    corners = corners.reshape(-1, 3).astype(np.uint64)
    return Manifold(Mesh64(np.ascontiguousarray(vertices[used]), np.ascontiguousarray(corners)))
