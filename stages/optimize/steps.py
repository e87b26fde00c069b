"""Damped Gauss-Newton steps on spheres: shape and smoothness, and what conformity needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..losses import conforming
from ..surface.edge_table import EdgeTable
from ..surface.geometry import vertex_normals
from ..surface.polygons import Floats, PolygonMesh
from ..surface.spheres import near_pairs
from .fitting import Rows, backward, forward
from .least_squares import Block, GaussNewton
from .spheres import SAFE, SMALLEST, Spheres

if TYPE_CHECKING:
    from ..sources.true_surface import TrueSurface

TERMS = ("intersection", "exclusion", "shape", "normal")
"""The losses that are recorded."""
SLACK = 0.15
"""How much further than a sphere's radius is searched, for what moves in a step."""
RADII = (0.3, 1.3)
"""Limits of the radii, in edge lengths."""
OFFSET = 0.5
"""``delta_f`` below which a pair is penalised, in edge lengths."""
MARGIN = 0.02
"""Power below which a generator that is not a sphere's own is penalised, in edge lengths
squared; twice SAFE where that is more."""
LARGEST_STEP = 0.12
"""Of a centre or radius, in edge lengths."""
DAMPING = 1e-2, 1e-4
"""The first and the smallest."""
EASIER, HARDER, TRIALS = 3.0, 5.0, 4
"""What the damping is divided by after a step that lowers the sum of squares, what it is
multiplied with after one that does not, and how often that is tried."""


class Steps:
    """Damped Gauss-Newton steps on ``(c_v, r_v)`` with fixed triangles and planes."""

    def __init__(
        self,
        spheres: Spheres,
        surface: TrueSurface,
        weights: Mapping[str, float],
        free: NDArray[np.bool_],
        threads: int,
    ) -> None:
        self.spheres = spheres
        self.weights, self.threads = weights, threads
        self.free = np.repeat(free, 4)
        self.margin = np.maximum(MARGIN, 2 * SAFE / spheres.lengths**2)
        self.length, self.face_length = self.spheres.lengths, self.spheres.face_lengths
        centres, triangles = spheres.centres, spheres.triangles
        if not np.isfinite(centres).all():
            raise NumericalFailure("a surface vertex is not finite: the training diverged")
        self.shape: list[tuple[Rows, Floats]] = []
        for way in (forward, backward):
            rows = way(surface, centres, triangles)
            hold = spheres.hold[rows.corners].min(axis=1)
            scale = weights["shape"] * len(centres) * rows.share * hold
            self.shape.append((rows, np.sqrt(scale) / self.length[rows.corners].mean(axis=1)))
        table = EdgeTable.of(triangles)
        start, end = np.concatenate([table.ends, table.ends[:, ::-1]]).T
        count = len(centres)
        share = 1 / np.bincount(start, minlength=count)
        self.row, self.column = (np.concatenate([np.arange(count), i]) for i in (start, end))
        self.entry = np.concatenate([np.ones(count), -share[start]])

    def run(self, ramp: list[float], damping: float) -> tuple[Spheres, Floats, float]:
        """A step for each factor in ``ramp`` to the weights of conformity; the spheres, the losses
        before each step and the damping."""
        losses = []
        spheres = self.spheres
        for factor in ramp:
            self._prepare(spheres, factor)
            residuals = self._residuals(spheres)
            total = sum(float(part @ part) for part in residuals.values())
            count = len(spheres.centres)
            losses.append([float(residuals[key] @ residuals[key]) / count for key in TERMS])
            problem = GaussNewton(self._blocks(spheres, residuals), self.free)
            for _ in range(TRIALS):
                moved = self._moved(spheres, problem.step(damping))
                after = sum(float(part @ part) for part in self._residuals(moved).values())
                if not np.isfinite(after):
                    raise NumericalFailure("sphere-train: a loss is not finite; lower the weights")
                if after < total:
                    spheres = moved
                    damping = max(damping / EASIER, DAMPING[1])
                    break
                damping *= HARDER
        return spheres, np.array(losses), damping

    def _moved(self, spheres: Spheres, step: Floats) -> Spheres:
        shift, growth = step.reshape(-1, 4)[:, :3], step.reshape(-1, 4)[:, 3]
        most = LARGEST_STEP * self.length
        size = np.maximum(np.linalg.norm(shift, axis=1), np.finfo(float).tiny)
        low, high = (limit * self.length for limit in RADII)
        return replace(
            spheres,
            centres=spheres.centres + shift * np.minimum(1.0, most / size)[:, None],
            radii=np.clip(spheres.radii + np.clip(growth, -most, most), low, high),
        )

    def _prepare(self, spheres: Spheres, factor: float) -> None:
        """What stays fixed during one step: near spheres, normals, weights."""
        mesh = PolygonMesh.of_triangles(spheres.centres, spheres.triangles)
        points, _ = spheres.generators()
        self.near = near_pairs(mesh, points, spheres.centres, spheres.radii, SLACK, self.threads)
        self.normal = vertex_normals(spheres.centres, spheres.triangles)
        self.strict = {
            key: np.sqrt(factor * self.weights[key]) for key in ("intersection", "exclusion")
        }

    def _laplacian(self, values: Floats) -> Floats:
        """Values ``(V, k)`` less the mean over their neighbours."""
        part = self.entry[:, None] * values[self.column]
        count = len(self.length)
        return np.stack([np.bincount(self.row, p, minlength=count) for p in part.T], axis=1)

    def _residuals(self, spheres: Spheres) -> dict[str, Floats]:
        points, square = spheres.generators()
        point, sphere = self.near
        arm = points[point] - spheres.centres[sphere]
        power = np.einsum("ij,ij->i", arm, arm) - spheres.radii[sphere] ** 2
        bend = self._laplacian(spheres.centres) / self.length[:, None]
        height = np.einsum("ij,ij->i", bend, self.normal)
        return {
            "intersection": self.strict["intersection"]
            * np.maximum(0.0, OFFSET**2 - square / self.face_length**2),
            "exclusion": self.strict["exclusion"]
            * np.maximum(0.0, self.margin[sphere] - power / self.length[sphere] ** 2),
            "shape": np.concatenate(
                [scale * rows.distance(spheres.centres) for rows, scale in self.shape]
            ),
            "normal": self._bending * height,
            "smooth": np.sqrt(self.weights["smooth"])
            * (bend - height[:, None] * self.normal).reshape(-1),
            "radius": np.sqrt(self.weights["radius"])
            * self._laplacian((spheres.radii / self.length)[:, None])[:, 0],
        }

    @property
    def _bending(self) -> Floats:
        """Root of the weight of bending: where the shape is let go, smoothness takes its place."""
        loose = self.weights["smooth"] * (1 - self.spheres.hold)
        return np.sqrt(self.weights["normal"] + loose)

    def _blocks(self, spheres: Spheres, residuals: dict[str, Floats]) -> list[Block]:
        centres, radii, triangles = spheres.centres, spheres.radii, spheres.triangles
        pairs, count = spheres.pairs(), len(spheres.triangles)
        blocks = []
        # Pairs that are to exist.
        row = np.flatnonzero(residuals["intersection"])
        columns, values = conforming.square_gradient(
            pairs.centre[row], triangles[row], centres, radii
        )
        values = values * (-self.strict["intersection"] / self.face_length[row] ** 2)[:, None]
        blocks.append(Block.dense(columns, values, residuals["intersection"][row]))
        # Generators that are to stay out of other spheres; one that stands for a missing pair
        # follows no sphere.
        row = np.flatnonzero(residuals["exclusion"])
        point, sphere = self.near[0][row], self.near[1][row]
        floor = (SMALLEST * self.face_length) ** 2
        face = point % count
        columns, values = conforming.power_gradient(
            pairs.points(floor)[point], triangles[face], sphere, centres, radii
        )
        values[pairs.square[face] <= floor[face], :12] = 0.0
        values *= (-self.strict["exclusion"] / self.length[sphere] ** 2)[:, None]
        blocks.append(Block.dense(columns, values, residuals["exclusion"][row]))
        done = 0
        for rows, scale in self.shape:
            columns = 4 * rows.corners[:, :, None] + np.arange(3)
            values = scale[:, None, None] * rows.gradient()
            part = residuals["shape"][done : done + len(scale)]
            blocks.append(Block.dense(columns, values, part))
            done += len(scale)
        return blocks + self._smoothing(residuals)

    def _smoothing(self, residuals: dict[str, Floats]) -> list[Block]:
        entry, row, column = self.entry, self.row, self.column
        normal, length = self.normal[row], self.length
        along = np.sqrt(self.weights["smooth"]) * (np.eye(3) - normal[:, :, None] * normal[:, None])
        along *= (entry / length[row])[:, None, None]
        across = (self._bending * np.ones(len(length)))[row, None] * normal
        across *= (entry / length[row])[:, None]
        axis = np.arange(3)
        places = np.broadcast_to(4 * column[:, None, None] + axis, along.shape)
        lines = np.broadcast_to(3 * row[:, None, None] + axis[:, None], along.shape)
        return [
            Block(lines.reshape(-1), places.reshape(-1), along.reshape(-1), residuals["smooth"]),
            Block(
                np.repeat(row, 3),
                (4 * column[:, None] + axis).reshape(-1),
                across.reshape(-1),
                residuals["normal"],
            ),
            Block(
                row,
                4 * column + 3,
                np.sqrt(self.weights["radius"]) * entry / length[column],
                residuals["radius"],
            ),
        ]
