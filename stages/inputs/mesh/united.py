"""Closed parts of a mesh that touch, cross or hold each other: taken apart, or united."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import NumericalFailure
from ...mesh.geometry import component_volumes, fan_triangles
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.queries.parity import RayParity
from ...mesh.queries.thickness import searched
from ...mesh.solids import solid_of
from ...mesh.topology import bad_edges, face_components, split_pinched
from .crossing_child import uncrossed

DIRECTIONS = 200
"""In which a face is looked at from outside."""
OFF = 1e-6
"""How far from a face, in diagonals of the bounding box, its rays start."""
SAME = 9
"""Digits of an angle to which faces lie on each other."""


@dataclass(frozen=True)
class Union:
    """What becomes of the closed parts of a mesh that cross or hold each other."""

    mesh: PolygonMesh | None
    """Their closed surface; None where no solid can be made of them."""
    crossing: int = 0
    """How many parts cross another."""
    buried: int = 0
    """How many lie within another that faces the same way."""
    folded: int = 0
    """How many cross themselves."""

    def facts(self) -> dict[str, int]:
        """For the manifest; nothing is united where there is no solid."""
        made = self.mesh is not None
        return {
            "united_parts": made * self.crossing,
            "buried_parts": made * self.buried,
            "folded_parts": made * self.folded,
        }

    def warnings(self, hollow: bool) -> list[str]:
        """What the user is told; ``hollow`` as for ``united``."""
        if self.mesh is None:
            return [
                "closed parts of the mesh cross themselves or each other, and no solid can be made "
                "of them: the inside is where the winding number is not 0, and the training starts "
                "from the first Voronoi surface; --repair may help"
            ]
        said = []
        if self.crossing:
            said.append(
                f"{self.crossing} closed parts of the mesh cross each other: they are united"
            )
        if self.folded:
            said.append(
                f"closed parts of the mesh that cross themselves: {self.folded}; they become the "
                "solid that they enclose"
            )
        if self.buried:
            taken = (
                "every second one becomes a hollow"
                if hollow
                else "those within a solid are left out; --shells alternate makes hollows of every "
                "second one"
            )
            said.append(
                "closed parts of the mesh that lie inside others and face the same way: "
                f"{self.buried}; {taken}"
            )
        return said


def united(mesh: PolygonMesh, hollow: bool = False) -> Union | None:
    """The union of the closed parts of ``mesh``, whose edges are all in two faces; None where each
    is outside all others or a cavity of one and none crosses itself.

    A part that is turned inside out is a cavity where it lies within another that it does not
    cross; elsewhere it is taken the right way round. One within another that faces the same way
    adds nothing; with ``hollow`` each second of such parts is a cavity. A part that crosses itself
    is what it winds around at least once.
    """
    from ...mesh.queries.intersections import self_intersections  # what it compiles with is large

    mesh = split_pinched(PolygonMesh.of_triangles(*fan_triangles(mesh)[:2]))
    count, part = face_components(mesh)
    triangles = mesh.face_vertices.reshape(-1, 3)
    pairs = part[self_intersections(mesh.vertices, triangles)]
    folded = np.unique(pairs[pairs[:, 0] == pairs[:, 1]])
    low, high = _boxes(mesh, part, count)
    if len(folded) == 0 and not _boxes_meet(low, high):
        return None
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    volume = component_volumes(mesh, part, count)
    depth = _depths(mesh, part, low, high, volume, np.unique(pairs))
    buried = depth > 0
    if len(pairs) == 0 and len(folded) == 0 and not buried.any():
        return None
    counts = len(np.unique(pairs)), int(buried.sum()), len(folded)
    if hollow:
        volume[depth % 2 == 1] *= -1
        triangles = np.where((depth % 2 == 1)[part][:, None], triangles[:, ::-1], triangles)
    from manifold3d import Manifold, OpType

    shells = [
        PolygonMesh.of_triangles(
            mesh.vertices, triangles[part == number][:, :: 1 if volume[number] > 0 else -1]
        ).without_unused_vertices()
        for number in range(count)
    ]
    for number in folded.tolist():
        whole = manifold(uncrossed(shells[number]))
        if whole is None:
            return Union(None, *counts)
        shells[number] = whole
    if count == 1:
        return Union(shells[0], *counts)
    try:
        solids = [solid_of(shell) for shell in shells]
    except NumericalFailure:
        return Union(None, *counts)
    outer = np.flatnonzero(volume > 0)
    outer = outer[np.argsort(volume[outer])]
    bodies = {number: solids[number] for number in outer.tolist()}
    for number in np.flatnonzero(volume <= 0).tolist():
        crossed = pairs[(pairs == number).any(axis=1)]
        tip = shells[number].vertices[:1]
        for around in outer[~np.isin(outer, crossed)].tolist():
            if RayParity(shells[around].vertices, fan_triangles(shells[around])[1]).inside(tip)[0]:
                bodies[around] = bodies[around] - solids[number]
                break
        else:
            bodies[number] = solids[number]
    found = Manifold.batch_boolean(list(bodies.values()), OpType.Add).to_mesh64()
    result = PolygonMesh.of_triangles(
        np.asarray(found.vert_properties)[:, :3].copy(), np.asarray(found.tri_verts, np.int64)
    )
    return Union(manifold(result), *counts)


def _depths(
    mesh: PolygonMesh, part: Ints, low: Floats, high: Floats, volume: Floats, crossing: Ints
) -> Ints:
    """How often the parts that face outward wind around each of them, ``(count,)``, counted for
    those that face outward and are not ``crossing`` another."""
    depth = np.zeros(len(low), dtype=np.int64)
    triangles = mesh.face_vertices.reshape(-1, 3)
    for number in np.flatnonzero(volume > 0):
        around = ((low <= low[number]) & (high >= high[number])).all(axis=1)
        around[number] = False
        if number in crossing or not around.any():
            continue
        rays = RayParity(mesh.vertices, triangles[around[part]])
        tip = mesh.vertices[triangles[np.argmax(part == number), :1]]
        depth[number] = max(0, int(rays.winding(tip)[0]))
    return depth


def manifold(mesh: PolygonMesh | None) -> PolygonMesh | None:
    """``mesh`` with parts that touch along edges taken apart; None where there is none."""
    if mesh is None or mesh.face_count == 0:
        return None
    if len(bad_edges(mesh)) == 0:
        return mesh
    apart = parted(mesh)
    return None if apart is None else apart[0]


def parted(mesh: PolygonMesh) -> tuple[PolygonMesh, int] | None:
    """The triangles of a ``mesh`` that is not closed, because its parts touch, as a closed one, and
    how many faces are left out; None where it is open otherwise.

    Faces that are there twice count once, and those that face each other not at all: two solids
    with a common face are one. At other edges of more than two faces, as where two solids touch
    along an edge, those two belong together that have a solid between them.
    """
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
    if len(kept) == 0:
        return None
    triangles = triangles[kept]
    corner = np.arange(triangles.size)
    start, following = triangles.reshape(-1), np.roll(corner.reshape(-1, 3), -1, axis=1).reshape(-1)
    one, other = _sides(vertices, triangles)
    # The two faces of an edge share the corners at both of its ends.
    ends = np.concatenate(
        [np.stack([one, following[other]], 1), np.stack([following[one], other], 1)]
    )
    count, group = components(len(corner), ends)
    at = np.zeros(count, dtype=np.int64)
    at[group] = start
    result = PolygonMesh.of_triangles(vertices[at], group.reshape(-1, 3))
    if len(bad_edges(result)):
        return None
    return result, left_out


def without_walls(mesh: PolygonMesh) -> tuple[PolygonMesh, int] | None:
    """The triangles of a ``mesh`` without walls between its chambers, as a closed surface turned as
    most of it was, and how many these are; None where it is open otherwise.

    At an edge of more than two faces a wall is what cannot be seen from outside on either side.
    """
    import igl

    vertices, triangles = fan_triangles(mesh)[:2]
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    key = ends.reshape(-1, 2) @ np.array([len(vertices), 1])
    _, edge, uses = np.unique(key, return_inverse=True, return_counts=True)
    if uses.min() < 2 or uses.max() == 2:
        return None
    crowded = (uses[edge.reshape(-1)] > 2).reshape(-1, 3).any(axis=1)
    _, patch = igl.bfs_orient(np.ascontiguousarray(triangles))
    asked = np.flatnonzero(np.isin(patch, patch[crowded]))
    hidden = asked[~_seen(vertices, triangles, asked)]
    left = np.delete(triangles, hidden, axis=0)
    if len(hidden) == 0 or len(left) == 0:
        return None
    agreed, part = igl.bfs_orient(np.ascontiguousarray(left))
    turned = ~np.any([(np.roll(agreed, k, axis=1) == left).all(axis=1) for k in range(3)], axis=0)
    wrong = np.bincount(part, turned) > 0.5 * np.bincount(part)
    agreed = np.where(wrong[part][:, None], agreed[:, ::-1], agreed).astype(np.int64)
    result = PolygonMesh.of_triangles(vertices, agreed).without_unused_vertices()
    return None if len(bad_edges(result)) else (result, len(hidden))


def _seen(vertices: Floats, triangles: Ints, asked: Ints) -> NDArray[np.bool_]:
    """Which triangles ``asked (K,)`` some ray from one of their sides leaves the surface."""
    tree, normals = searched(vertices, triangles)
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    seen = np.zeros(len(asked), dtype=bool)
    golden = np.pi * (1 + 5**0.5)
    for k in range(DIRECTIONS):
        height = 1 - (2 * k + 1) / DIRECTIONS
        width = np.sqrt(1 - height**2)
        way = np.array([width * np.cos(golden * k), width * np.sin(golden * k), height])
        left = np.flatnonzero(~seen)
        facing = normals[asked[left]]
        # From the side that the direction leaves from, near the middle and near each corner.
        facing = np.where((facing @ way < 0)[:, None], -facing, facing)
        for weights in (np.full(3, 1 / 3), *(np.eye(3) * 0.85 + 0.05)):
            corners = vertices[triangles[asked[left]]]
            start = np.einsum("k,nkj->nj", weights, corners) + OFF * size * facing
            reach, _ = tree.first_met(start, np.broadcast_to(way, start.shape))
            seen[left[np.isinf(reach)]] = True
    return seen


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


def _boxes(mesh: PolygonMesh, part: Ints, count: int) -> tuple[Floats, Floats]:
    """Lower and upper corners of the boxes of ``count`` parts; ``part (F,)`` is that of a face."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    at, of = mesh.vertices[mesh.face_vertices], part[mesh.corner_faces]
    np.minimum.at(low, of, at)
    np.maximum.at(high, of, at)
    return low, high


def _boxes_meet(low: Floats, high: Floats) -> bool:
    """Whether two of the boxes have a point in common."""
    # Sorted along an axis, a box can only meet those that begin before it ends.
    order = np.argsort(low[:, 0])
    last = np.searchsorted(low[order, 0], high[order, 0], side="right")
    for number, end in enumerate(last):
        own, others = order[number], order[number + 1 : end]
        meets = (low[others] <= high[own]).all(axis=1) & (high[others] >= low[own]).all(axis=1)
        if meets.any():
            return True
    return False
