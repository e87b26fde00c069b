"""The least-squares problem of spheres on triangles: shape, smoothness, intersection, exclusion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.edge_table import EdgeTable
from ..mesh.geometry import limited, vertex_normals
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.spheres import near_pairs
from ..remesh.fitting import Rows, backward, forward
from ..solvers.laplacian import Laplacian
from ..solvers.least_squares import Block
from .losses import triangle_pairs
from .spheres import SAFE, Spheres, rings_around

if TYPE_CHECKING:
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface

SLACK = 0.15
"""The search for intruders extends beyond a sphere by this share of its radius, because
things move in a step."""
RADII = (0.3, 1.3)
"""Smallest and largest radius, in edge lengths."""
OFFSET = 0.35
"""A pair with a smaller ``delta_f``, in edge lengths, is penalised; at creases it is less. Thin
parts have no room for a larger value."""
MARGIN = 0.02
"""A generator with a smaller power to a sphere that is not of its face is penalised. The unit is
the squared edge length; where twice SAFE is more, that is used."""
SHARP = 1000.0
"""Weight of the squared distance of a vertex from its crease, in edge lengths."""
LARGEST_STEP = 0.12
"""Largest step of a centre or a radius, in edge lengths."""


def on_creases(creases: Creases, spheres: Spheres) -> Rows:
    """The vertices on creases, with two planes through the crease of each; at a corner three."""
    at = np.flatnonzero(spheres.rank > 0)
    foot, tangent = creases.closest(spheres.centres[at], spheres.as_mesh().chains()[at])
    axis = np.eye(3)[np.abs(tangent).argmin(axis=1)]
    across = np.cross(tangent, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    corner = spheres.rank[at] == 2
    vertex = np.concatenate([at, at, at[corner]])
    direction = np.concatenate([across, np.cross(tangent, across), tangent[corner]])
    place = np.concatenate([foot, foot, foot[corner]])
    if corner.any():
        from scipy.spatial import cKDTree

        exact = creases.corners
        near = exact[cKDTree(exact).query(spheres.centres[at[corner]])[1]]
        place[np.flatnonzero(corner)] = near
        place[len(at) + np.flatnonzero(corner)] = near
        place[2 * len(at) :] = near
    return Rows(
        np.repeat(vertex[:, None], 3, axis=1),
        np.tile([1.0, 0.0, 0.0], (len(vertex), 1)),
        direction,
        np.einsum("ij,ij->i", direction, place),
        np.full(len(vertex), 1 / max(1, len(vertex))),
    )


MISSING = 1e3
"""The residual of a missing pair does not grow beyond this. Such a triangle is nearly flat, and
only a change of the triangles can help."""


def _softened(missing: Floats) -> Floats:
    """The residuals of missing pairs, which grow as the logarithm from 1 on, up to MISSING.

    Otherwise one triangle without area, whose spheres do not meet, would outweigh all others.
    """
    return np.where(missing > 1, 1 + np.log(missing.clip(1.0, MISSING)), missing)


class OnSpheres:
    """What is common to problems with the unknowns ``(c_v, r_v)``."""

    width = 4
    limits = RADII
    """Smallest and largest radius, in edge lengths."""
    count: int
    length: Floats
    triangles: Ints
    """The triangles ``(T, 3)`` of the surface."""
    near: tuple[Ints, Ints]
    """Pairs of a generator and a sphere that is near it and not of its face."""
    shape: list[tuple[Rows, Floats]]

    def moved(self, state: Spheres, step: Floats) -> Spheres:
        shift, growth = step.reshape(-1, 4)[:, :3], step.reshape(-1, 4)[:, 3]
        most = LARGEST_STEP * self.length
        low, high = (limit * self.length for limit in self.limits)
        radii = np.clip(state.radii + np.clip(growth, -most, most), low, high)
        return replace(state, centres=state.centres + limited(shift, most), radii=radii)

    def around(self, places: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return rings_around(self.triangles, places, 1)

    def spread(self, values: Floats) -> Floats:
        return np.repeat(values, 4)

    def summed(self, residuals: dict[str, Floats], of: dict[str, Ints]) -> Floats:
        """The sum of squared residuals over the triangles around each vertex, ``(V,)``.

        ``of`` has the vertices ``(R, k)`` of each residual.
        """
        own = np.zeros(self.count)
        for key, residual in residuals.items():
            square = np.repeat(residual**2, of[key].shape[1])
            own += np.bincount(of[key].reshape(-1), square, minlength=self.count)
        sums = np.repeat(own[self.triangles].sum(axis=1), 3)
        return np.asarray(np.bincount(self.triangles.reshape(-1), sums, minlength=self.count))

    def powers(self, state: Spheres, points: Floats) -> Floats:
        """The powers of generators to the spheres near them, in squared edge lengths."""
        point, sphere = self.near
        arm = points[point] - state.centres[sphere]
        power = np.einsum("ij,ij->i", arm, arm) - state.radii[sphere] ** 2
        return np.asarray(power / self.length[sphere] ** 2)

    def distances(self, state: Spheres) -> Floats:
        """The weighted distances of the samples of the shape to their planes."""
        return np.concatenate([scale * rows.distance(state.centres) for rows, scale in self.shape])

    def shape_blocks(self, residual: Floats) -> list[Block]:
        blocks, done = [], 0
        for rows, scale in self.shape:
            columns = 4 * rows.corners[:, :, None] + np.arange(3)
            values = scale[:, None, None] * rows.gradient()
            blocks.append(Block.dense(columns, values, residual[done : done + len(scale)]))
            done += len(scale)
        return blocks

    def exclusion_block(
        self, state: Spheres, pairs: triangle_pairs.Pairs, weight: float, residual: Floats
    ) -> Block:
        """The residuals of generators in other spheres, with their derivatives.

        A generator of a missing pair does not follow the spheres. ``weight`` is the square root of
        the weight.
        """
        row = np.flatnonzero(residual)
        point, sphere = self.near[0][row], self.near[1][row]
        floor, face = state.smallest**2, point % len(state.triangles)
        columns, values = triangle_pairs.power_gradient(
            pairs.points(floor)[point], state.triangles[face], sphere, state.centres, state.radii
        )
        values[pairs.square[face] <= floor[face], :12] = 0.0
        values *= (-weight / self.length[sphere] ** 2)[:, None]
        return Block.dense(columns, values, residual[row])


class SphereProblem(OnSpheres):
    """Least squares with the unknowns ``(c_v, r_v)``, and fixed triangles and planes.

    Only the ``free (V,)`` spheres move. If the problem is ``local``, it consists of those on which
    these depend, else of all. They are ``start``, the spheres at ``vertices (V',)``.
    """

    def __init__(
        self,
        spheres: Spheres,
        surface: TrueSurface,
        creases: Creases | None,
        weights: Mapping[str, float],
        free: NDArray[np.bool_],
        threads: int,
        local: bool = False,
    ) -> None:
        self.weights, self.threads = weights, threads
        centres, triangles = spheres.centres, spheres.triangles
        if not np.isfinite(centres).all():
            raise NumericalFailure(
                "a surface vertex is not finite, since the training diverged; lower the weights"
            )
        vertices, faces = np.arange(len(centres)), np.ones(len(triangles), dtype=bool)
        if local:
            vertices, faces = spheres.meeting(free, threads)
        part = spheres.part(vertices, faces)
        self.vertices, self.start, self.triangles = vertices, part, part.triangles
        self.free, self.count = np.repeat(free[vertices], 4), len(vertices)
        self.margin = np.maximum(MARGIN, 2 * SAFE / part.lengths**2)
        self.length, self.face_length = part.lengths, part.face_lengths
        self.offset = OFFSET * part.face_room
        self.units: Floats | None = np.repeat(part.lengths, 4)
        samples = []
        for way in (forward, backward):
            rows = way(surface, centres, triangles)
            samples.append((rows, weights["shape"] * len(centres) * rows.share))
        if creases is not None:
            rows = on_creases(creases, spheres)
            samples.append((rows, np.full(len(rows.share), SHARP)))
        self.shape = []
        for rows, scale in samples:
            some = np.asarray(free[rows.corners].any(axis=1))
            rows, scale = rows.some(some), scale[some]
            scale = np.sqrt(scale * spheres.hold[rows.corners].min(axis=1))
            scale /= spheres.lengths[rows.corners].mean(axis=1)
            corners = np.searchsorted(vertices, rows.corners)
            self.shape.append((replace(rows, corners=corners), scale))
        ends = EdgeTable.of(triangles).ends
        if local:
            number = np.full(len(centres), -1)
            number[vertices] = np.arange(len(vertices))
            ends = number[ends]
            ends = ends[(ends >= 0).all(axis=1)]
        self.laplacian = Laplacian.of(ends, self.count)
        # Where the pull to the true surface is reduced, smoothness replaces it.
        loose = weights["smooth"] * (1 - part.hold)
        self.bending = np.sqrt(weights["normal"] + loose) / self.length
        self.smoothing = np.sqrt(weights["smooth"]) / self.length
        self.evening = np.sqrt(weights["radius"]) / self.length
        # At creases the surface is not made smooth.
        for factor in (self.bending, self.smoothing):
            factor[part.rank > 0] = 0.0

    def energies(self, residuals: dict[str, Floats]) -> Floats:
        """The sum of squared residuals over the triangles around each vertex, ``(V,)``."""
        triangles, (point, sphere) = self.triangles, self.near
        vertex = np.arange(self.count)[:, None]
        of = {
            "intersection": triangles,
            "exclusion": np.column_stack([triangles[point % len(triangles)], sphere]),
            "shape": np.concatenate([rows.corners for rows, _ in self.shape]),
            "normal": vertex,
            "smooth": np.repeat(vertex, 3, axis=0),
            "radius": vertex,
        }
        return self.summed(residuals, of)

    def prepare(self, state: Spheres, factor: float) -> None:
        mesh = PolygonMesh.of_triangles(state.centres, state.triangles)
        points, _ = state.generators()
        self.near = near_pairs(mesh, points, state.centres, state.reach, SLACK, self.threads)
        self.normal = vertex_normals(state.centres, state.triangles)
        self.strict = {
            key: np.sqrt(factor * self.weights[key]) for key in ("intersection", "exclusion")
        }

    def residuals(self, state: Spheres) -> dict[str, Floats]:
        points, square = state.generators()
        bend = self.laplacian(state.centres)
        height = np.einsum("ij,ij->i", bend, self.normal)
        return {
            "intersection": self.strict["intersection"]
            * _softened(np.maximum(0.0, self.offset**2 - square / self.face_length**2)),
            "exclusion": self.strict["exclusion"]
            * np.maximum(0.0, self.margin[self.near[1]] - self.powers(state, points)),
            "shape": self.distances(state),
            "normal": self.bending * height,
            "smooth": (self.smoothing[:, None] * (bend - height[:, None] * self.normal)).reshape(
                -1
            ),
            "radius": self.laplacian((self.evening * state.radii)[:, None])[:, 0],
        }

    def blocks(self, state: Spheres, residuals: dict[str, Floats]) -> list[Block]:
        centres, radii, triangles = state.centres, state.radii, state.triangles
        pairs = state.pairs()
        blocks = []
        # Residuals of pairs that do not exist, or are too close.
        row = np.flatnonzero(residuals["intersection"])
        columns, values = triangle_pairs.square_gradient(
            pairs.centre[row], triangles[row], centres, radii
        )
        # The derivative of ``_softened``.
        short = self.offset[row] ** 2 - pairs.square[row] / self.face_length[row] ** 2
        slope = -self.strict["intersection"] / np.maximum(1.0, short)
        slope[short > MISSING] = 0.0
        values = values * (slope / self.face_length[row] ** 2)[:, None]
        blocks.append(Block.dense(columns, values, residuals["intersection"][row]))
        blocks.append(
            self.exclusion_block(state, pairs, self.strict["exclusion"], residuals["exclusion"])
        )
        blocks += self.shape_blocks(residuals["shape"])
        return [
            *blocks,
            self.laplacian.along(self.normal, self.smoothing, residuals["smooth"]),
            self.laplacian.across(self.normal, self.bending, residuals["normal"]),
            self.laplacian.radii(self.evening, residuals["radius"]),
        ]
