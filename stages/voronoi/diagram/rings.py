"""Voronoi faces as rings of Delaunay tetrahedra around an edge, all found at the same time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import NumericalFailure
from ...mesh.polygons import PolygonMesh
from .delaunay import Floats, Ints, Tetrahedra

# The six edges of a tetrahedron, and the two corners that are not on each of them.
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
OPPOSITE = np.array([[2, 3], [1, 3], [1, 2], [0, 3], [0, 2], [0, 1]])
EDGE_OF = np.full((4, 4), -1)
EDGE_OF[EDGES[:, 0], EDGES[:, 1]] = EDGE_OF[EDGES[:, 1], EDGES[:, 0]] = np.arange(6)


def _beyond() -> Ints:
    """The table ``[out, into, edge]`` of steps from one tetrahedron to the next around an edge.

    The step leaves a tetrahedron opposite its corner ``out`` and enters the next one opposite its
    corner ``into``. The entry is twice the number of the edge in the next tetrahedron, plus the
    side on which the walk leaves that one. Corners are ascending in both.
    """
    table = np.full((4, 4, 6), -1)
    for out in range(4):
        for into in range(4):
            # The three corners of the shared triangle, in both tetrahedra.
            rest = [np.delete(np.arange(4), corner) for corner in (out, into)]
            there = dict(zip(*rest, strict=True))
            for edge in np.flatnonzero(np.all(out != EDGES, axis=1)):
                same = EDGE_OF[there[EDGES[edge, 0]], there[EDGES[edge, 1]]]
                table[out, into, edge] = 2 * same + (OPPOSITE[same, 0] == into)
    return table


BEYOND = _beyond()
THIN = 1e-6
"""The orientation of a tetrahedron is not reliable if six times its volume, divided by the cube of
an edge, is less than this."""

Selection = Callable[[Ints, Ints], NDArray[np.int8]]


@dataclass(frozen=True)
class Rings:
    """Voronoi faces: ``generators (F, 2)``, and the tetrahedra around each face in compressed rows.

    A ring is counter-clockwise seen from the second generator, so that the normal of the face
    points from the first to the second.
    """

    generators: Ints
    offsets: Ints
    tetrahedra: Ints


def voronoi_rings(generators: Floats, tetrahedra: Tetrahedra, select: Selection) -> Rings:
    """The Voronoi faces of the Delaunay edges that ``select`` chooses, sorted by their pair.

    ``select(a, b)`` gets arrays of generator indices. It returns 1 where the face from a to b is
    wanted, -1 where the face from b to a is, and 0 where none is. Raises NumericalFailure if a
    wanted face is unbounded, because its edge lies on the convex hull, or if the tetrahedra around
    an edge do not form a ring.
    """
    wanted = select(tetrahedra.corners[:, EDGES[:, 0]], tetrahedra.corners[:, EDGES[:, 1]])
    # From here on, only tetrahedra with a wanted edge are numbered.
    used = np.flatnonzero(wanted.any(axis=1))
    wanted, corners = wanted[used], tetrahedra.corners[used]
    number = np.full(len(tetrahedra.corners) + 1, -1)
    number[used] = np.arange(len(used))
    neighbours = number[tetrahedra.neighbours[used]]
    tet, edge = np.nonzero(wanted)
    if len(tet) == 0:
        return Rings(np.zeros((0, 2), np.int64), np.zeros(1, np.int64), np.zeros(0, np.int64))
    forward = wanted[tet, edge] > 0
    first = corners[tet, np.where(forward, EDGES[edge, 0], EDGES[edge, 1])]
    second = corners[tet, np.where(forward, EDGES[edge, 1], EDGES[edge, 0])]
    incidence = np.full(wanted.shape, -1, dtype=np.int64)
    incidence[tet, edge] = np.arange(len(tet))

    # The walk at (incidence, side) leaves the tetrahedron opposite its corner OPPOSITE[edge, side].
    back = (neighbours[neighbours] == np.arange(len(used))[:, None, None]).argmax(axis=2)
    leaving = np.empty((len(tet), 2), dtype=np.int64)
    for side in (0, 1):
        corner = OPPOSITE[edge, side]
        beyond = neighbours[tet, corner]
        if (beyond < 0).any():
            raise NumericalFailure(
                "a Voronoi face of the surface is unbounded, since generators moved far "
                "away; raise -n, or close the openings of the input"
            )
        then = BEYOND[corner, back[tet, corner], edge]
        leaving[:, side] = 2 * incidence[beyond, then >> 1] + (then & 1)
    following = leaving.reshape(-1)

    key = first * len(generators) + second
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    valence = np.diff(starts, append=len(order))
    origin = 2 * order[starts]
    state = origin.copy()
    walked = np.empty(len(order), dtype=np.int64)
    for step in range(int(valence.max())):
        active = np.flatnonzero(valence > step)
        walked[starts[active] + step] = state[active]
        state[active] = following[state[active]]
    if not np.array_equal(state, origin) or (np.bincount(walked >> 1) > 1).any():
        raise NumericalFailure(
            "the Delaunay tetrahedra do not close around an edge; change -n a little"
        )

    def wedges(walk: Ints) -> tuple[Floats, NDArray[np.bool_]]:
        """Six times the signed volumes by which steps turn about the edge, and whether they are too
        flat to tell. Tetrahedra come without orientation."""
        at, turned = walk >> 1, walk & 1
        base = generators[first[at]]
        ahead, left, right = (
            generators[which] - base
            for which in (
                second[at],
                corners[tet[at], OPPOSITE[edge[at], 0]],
                corners[tet[at], OPPOSITE[edge[at], 1]],
            )
        )
        volume = np.einsum("ij,ij->i", ahead, np.cross(left, right))
        flat = np.abs(volume) < THIN * np.einsum("ij,ij->i", ahead, ahead) ** 1.5
        return np.where(turned == 0, volume, -volume), flat

    # The first tetrahedron gives the direction of its ring. If it is too flat, the sum of all does.
    sense, unsure = wedges(walked[starts])
    ring = np.repeat(np.arange(len(starts)), valence)
    asked = unsure[ring]
    total = np.bincount(ring[asked], wedges(walked[asked])[0], minlength=len(starts))
    clockwise = np.where(unsure, total, sense) < 0
    offsets = np.append(starts, len(order)).astype(np.int64)
    around = used[tet[walked >> 1]]
    within = np.arange(len(around)) - starts[ring]
    mirrored = (starts + valence - 1)[ring] - within
    around = np.where(clockwise[ring], around[mirrored], around)
    pairs = np.stack([first[order[starts]], second[order[starts]]], axis=1)
    return Rings(pairs, offsets, around)


def select_interface(inside: NDArray[np.bool_]) -> Selection:
    """Selects the edges from an inside to an outside generator."""
    labels = inside.astype(np.int8)
    return lambda a, b: (labels[a] - labels[b]).astype(np.int8)


def ring_mesh(rings: Rings) -> tuple[PolygonMesh, Ints]:
    """The polygons of ``rings`` over numbered tetrahedra, and the tetrahedron of each number.

    All vertices are still at the origin.
    """
    present = np.zeros(rings.tetrahedra.max(initial=-1) + 1, dtype=bool)
    present[rings.tetrahedra] = True
    used, number = np.flatnonzero(present), np.cumsum(present) - 1
    return PolygonMesh(np.zeros((len(used), 3)), rings.offsets, number[rings.tetrahedra]), used
