"""The least-squares problem of spheres on polygons: shape, agreement of corners, and exclusion.

A face lies between its two generators if ``u = |c|^2 - r^2`` is linear on it. So it conforms if its
corners lie in one plane, and if one point of the plane has the same power to all spheres. Three
corners define the pair of the face in closed form. Every further corner adds these two equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.spheres import near_pairs
from ..mesh.topology import edges
from ..remesh.fitting import backward, forward
from ..solvers.laplacian import Laplacian
from ..solvers.least_squares import Block
from .losses import triangle_pairs
from .sphere_problem import SHARP, SLACK, OnSpheres, on_creases
from .spheres import SAFE, Spheres

if TYPE_CHECKING:
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface

RADII = (0.3, 2.5)
"""Smallest and largest radius, in edge lengths."""
OFFSET = 0.3
"""A pair with a smaller ``delta_f``, in edge lengths, is penalised; at creases it is less."""
MARGIN = 0.1
"""A generator with a smaller power to a sphere that is not of its face is penalised. The unit is
the squared edge length."""
CONVEX = 0.2
"""Three successive corners are penalised if twice their signed area is less, in
squared edge lengths."""


@dataclass(frozen=True)
class Corners:
    """The three corners ``defining (F, 3)`` of each face, and all further corners.

    A further corner is the ``vertex (E,)`` of a ``face (E,)``.
    """

    defining: Ints
    face: Ints
    vertex: Ints
    bent: Floats
    """1 for each further corner, or 0 if all corners of its face are in a known plane, ``(E,)``."""

    @classmethod
    def of(cls, mesh: PolygonMesh, plane: NDArray[np.bool_]) -> Corners:
        """The corners of ``mesh``: those about evenly spaced whose triangle is largest define the
        pair.

        ``plane (F,)`` says which faces are in a known plane.
        """
        valence, start = mesh.valences, mesh.face_offsets[:-1]
        best = np.full(mesh.face_count, -1.0)
        places = np.zeros((mesh.face_count, 3), np.int64)
        for first in range(int(valence.max(initial=3))):
            steps = np.stack([0 * valence, valence // 3, (2 * valence) // 3], axis=1)
            tried = (first + steps) % valence[:, None]
            at = mesh.vertices[mesh.face_vertices[start[:, None] + tried]]
            area = np.linalg.norm(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]), axis=1)
            better = area > best
            best[better], places[better] = area[better], tried[better]
        corners = start[:, None] + places
        further = np.ones(len(mesh.face_vertices), dtype=bool)
        further[corners] = False
        # The corners of triangles keep their order.
        plain = valence == 3
        corners[plain] = start[plain, None] + np.arange(3)
        face = mesh.corner_faces[further]
        return cls(
            mesh.face_vertices[corners], face, mesh.face_vertices[further],
            np.where(plane[face], 0.0, 1.0),
        )  # fmt: skip


@dataclass(frozen=True)
class Planes:
    """Known planes ``normal . c = offset``, in which the centres of spheres
    ``vertex (K,)`` must lie."""

    vertex: Ints
    normal: Floats
    offset: Floats

    def heights(self, centres: Floats) -> Floats:
        """The distances ``(K,)`` of ``centres (V, 3)`` from their planes."""
        height = np.einsum("ij,ij->i", centres[self.vertex], self.normal)
        return np.asarray(height - self.offset)

    @property
    def columns(self) -> Ints:
        """The unknowns of ``(c_v, r_v)`` on which the heights depend; the
        normals are the derivatives."""
        return 4 * self.vertex[:, None] + np.arange(3)


def incidence(
    state: Spheres, corners: Corners
) -> tuple[Floats, Floats, Floats, triangle_pairs.Pairs]:
    """The deviation of each further corner, and what its derivatives need.

    Returns its height above the plane of the face ``(E,)``; the power of the radical centre to its
    sphere minus that to the defining ones ``(E,)``; its barycentric coordinates ``(E, 3)`` among
    the defining corners; and the pairs of the faces.
    """
    pairs = state.pairs()
    at = state.centres[corners.defining[corners.face]]
    u, v, w = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0], state.centres[corners.vertex] - at[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    determinant = np.maximum(uu * vv - uv * uv, np.finfo(float).tiny)
    s, t = (vv * wu - uv * wv) / determinant, (uu * wv - uv * wu) / determinant
    height = corners.bent * np.einsum("ij,ij->i", w, pairs.normal[corners.face])
    arm = state.centres[corners.vertex] - pairs.centre[corners.face]
    power = np.einsum("ij,ij->i", arm, arm) - state.radii[corners.vertex] ** 2
    power += pairs.square[corners.face]
    return height, power, np.stack([1 - s - t, s, t], axis=1), pairs


def incidence_gradient(
    state: Spheres, corners: Corners, share: Floats, pairs: triangle_pairs.Pairs
) -> tuple[Ints, Floats, Floats]:
    """Derivatives of both deviations: columns ``(E, 16)`` of ``(c_v, r_v)``, and values
    ``(E, 16)``.

    The derivative of the power is exact if the corner is in the plane.
    """
    own = corners.defining[corners.face]
    vertex = np.concatenate([corners.vertex[:, None], own], axis=1)
    weight = np.concatenate([np.ones((len(own), 1)), -share], axis=1)[:, :, None]
    normal = (corners.bent[:, None] * pairs.normal[corners.face])[:, None]
    height = np.concatenate([weight * normal, np.zeros((len(own), 4, 1))], axis=2)
    arm = state.centres[vertex] - pairs.centre[corners.face][:, None]
    power = 2 * weight * np.concatenate([arm, -state.radii[vertex][:, :, None]], axis=2)
    columns = (4 * vertex[:, :, None] + np.arange(4)).reshape(-1, 16)
    return columns, height.reshape(-1, 16), power.reshape(-1, 16)


def halves(mesh: PolygonMesh) -> Ints:
    """Triangles ``(T, 3)`` of the faces, as fans about their first corners."""
    face, place = mesh.corner_faces, np.arange(len(mesh.face_vertices))
    start = mesh.face_offsets[:-1][face]
    inner = (place > start) & (place < start + mesh.valences[face] - 1)
    return np.stack([mesh.face_vertices[start], mesh.face_vertices, mesh.next_vertices], axis=1)[
        inner
    ]


class PolygonProblem(OnSpheres):
    """Least squares with the unknowns ``(c_v, r_v)`` at the corners of
    polygons, and fixed planes."""

    limits = RADII

    def __init__(
        self,
        faces: PolygonMesh,
        corners: Corners,
        planes: Planes,
        state: Spheres,
        start: Floats,
        wanted: Floats,
        free: NDArray[np.bool_],
        surface: TrueSurface,
        creases: Creases | None,
        weights: Mapping[str, float],
        threads: int,
    ) -> None:
        self.faces, self.corners, self.start, self.wanted = faces, corners, start, wanted
        self.planes, self.weights, self.threads = planes, weights, threads
        self.count = len(state.centres)
        self.free = np.repeat(free, 4)
        self.length, self.face_length = state.lengths, state.face_lengths
        self.units: Floats | None = np.repeat(self.length, 4)
        self.margin = np.maximum(MARGIN, 2 * SAFE / self.length**2)
        self.offset = OFFSET * state.face_room
        self.convex = CONVEX
        self.triangles = halves(faces)
        self.shape = []
        for way in (forward, backward):
            rows = way(surface, state.centres, self.triangles)
            scale = np.sqrt(weights["shape"] * self.count * rows.share)
            self.shape.append((rows, scale / self.length[rows.corners].mean(axis=1)))
        if creases is not None:
            rows = on_creases(creases, state)
            self.shape.append((rows, np.sqrt(SHARP) / self.length[rows.corners[:, 0]]))
        large = np.flatnonzero(faces.valences[faces.corner_faces] > 3)
        here, after = faces.next_corners[large], faces.next_corners[faces.next_corners[large]]
        self.turns = faces.face_vertices[np.stack([large, here, after], axis=1)]
        self.turn_face = faces.corner_faces[large]
        self.laplacian = Laplacian.of(edges(faces), self.count)
        self.smoothing = np.sqrt(weights["smooth"]) / self.length
        self.wanting = np.sqrt(weights["radius"]) / self.length

    def energies(self, residuals: dict[str, Floats]) -> Floats:
        point, sphere = self.near
        own, count = self.corners.defining, len(self.corners.defining)
        of = {
            "intersection": np.tile(
                np.column_stack([self.corners.vertex, own[self.corners.face]]), (2, 1)
            ),
            "plane": self.planes.vertex[:, None],
            "offset": own,
            "convex": self.turns,
            "exclusion": np.column_stack([own[point % count], sphere]),
            "shape": np.concatenate([rows.corners for rows, _ in self.shape]),
            "smooth": np.repeat(np.arange(self.count)[:, None], 3, axis=0),
            "radius": np.arange(self.count)[:, None],
        }
        return self.summed(residuals, of)

    def prepare(self, state: Spheres, factor: float) -> None:
        points, _ = state.generators()
        mesh = self.faces.with_vertices(state.centres)
        self.near = near_pairs(mesh, points, state.centres, state.reach, SLACK, self.threads)
        self.exact = np.sqrt(factor)
        self.facing = state.pairs().normal[self.turn_face]

    def residuals(self, state: Spheres) -> dict[str, Floats]:
        points, square = state.generators()
        height, beyond, _, _ = incidence(state, self.corners)
        size = self.face_length[self.corners.face]
        bend = self.laplacian(state.centres - self.start)
        a, b, c = (state.centres[self.turns[:, k]] for k in range(3))
        double = np.einsum("ij,ij->i", np.cross(b - a, c - b), self.facing)
        strict = np.sqrt(self.weights["exclusion"])
        return {
            "intersection": self.exact * np.concatenate([height / size, beyond / size**2]),
            "plane": self.exact
            * self.planes.heights(state.centres)
            / self.length[self.planes.vertex],
            "offset": strict * np.maximum(0.0, self.offset**2 - square / self.face_length**2),
            "convex": strict
            * np.maximum(0.0, self.convex - double / self.face_length[self.turn_face] ** 2),
            "exclusion": strict
            * np.maximum(0.0, self.margin[self.near[1]] - self.powers(state, points)),
            "shape": self.distances(state),
            "smooth": (self.smoothing[:, None] * bend).reshape(-1),
            "radius": self.wanting * (state.radii - self.wanted),
        }

    def blocks(self, state: Spheres, residuals: dict[str, Floats]) -> list[Block]:
        centres, radii, own = state.centres, state.radii, self.corners.defining
        _, _, share, pairs = incidence(state, self.corners)
        columns, height, power = incidence_gradient(state, self.corners, share, pairs)
        size = self.face_length[self.corners.face][:, None]
        blocks = [
            Block.dense(
                np.concatenate([columns, columns]),
                self.exact * np.concatenate([height / size, power / size**2]),
                residuals["intersection"],
            )
        ]
        values = self.planes.normal * (self.exact / self.length[self.planes.vertex])[:, None]
        blocks.append(Block.dense(self.planes.columns, values, residuals["plane"]))
        strict = np.sqrt(self.weights["exclusion"])
        row = np.flatnonzero(residuals["offset"])
        columns, values = triangle_pairs.square_gradient(
            pairs.centre[row], own[row], centres, radii
        )
        values = values * (-strict / self.face_length[row] ** 2)[:, None]
        blocks.append(Block.dense(columns, values, residuals["offset"][row]))
        row = np.flatnonzero(residuals["convex"])
        a, b, c = (centres[self.turns[row, k]] for k in range(3))
        gradient = np.cross(self.facing[row][:, None], np.stack([c - b, a - c, b - a], axis=1))
        values = gradient * (-strict / self.face_length[self.turn_face[row]] ** 2)[:, None, None]
        columns = 4 * self.turns[row][:, :, None] + np.arange(3)
        blocks.append(Block.dense(columns, values, residuals["convex"][row]))
        blocks.append(self.exclusion_block(state, pairs, strict, residuals["exclusion"]))
        blocks += self.shape_blocks(residuals["shape"])
        lap = self.laplacian
        axis = np.arange(3)
        blocks.append(
            Block(
                (3 * lap.rows[:, None] + axis).reshape(-1),
                (4 * lap.columns[:, None] + axis).reshape(-1),
                np.repeat(self.smoothing[lap.rows] * lap.entries, 3),
                residuals["smooth"],
            )
        )
        every = np.arange(self.count)
        blocks.append(Block(every, 4 * every + 3, self.wanting, residuals["radius"]))
        return blocks
