"""Training of polygon faces: spheres and pairs of generators, all free, brought together.

More than three spheres meet in two points only where their surface allows it, so the pairs cannot
be had in closed form as those of triangles can; they are unknowns, and the powers of the spheres to
them are brought down beside everything else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..surface.geometry import face_frames, limited, vertex_normals
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.spheres import near_pairs
from ..surface.topology import edges
from .descent import TERMS, descend, first_damping
from .fitting import Rows, backward, forward
from .laplacian import Laplacian
from .least_squares import Block

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..contract import Progress
    from ..sources.true_surface import TrueSurface

OFFSET = 0.6
"""``delta_f`` to start from, below which a pair is penalised; in roots of its face's area."""
MARGIN = 0.05
"""Power below which a generator that is not a sphere's own is penalised, in faces' areas."""
CENTRED = 0.02
"""Weight of a pair's middle at the middle of its face."""
SLACK = 0.15
"""How much further than a sphere's radius is searched, for what moves in a step."""
LARGEST_STEP = 0.2
"""Of a centre, radius or generator, in roots of a face's area."""
BEFORE = 100_000
"""Checkpoints are numbered from here, behind those of the triangles that it starts from."""
LEG = 3
"""Steps between searches for closest points, and between checkpoints."""
EASY, START = 0.1, 0.35
"""Share of the intersection's weight in the first steps, and the share of steps that are."""


@dataclass(frozen=True)
class Paired:
    """Polygons with spheres at their vertices and a pair of generators each, in model units."""

    centres: Floats
    radii: Floats
    outer: Floats
    inner: Floats

    @classmethod
    def at(cls, mesh: PolygonMesh) -> Paired:
        """Pairs across the middles of the faces; radii from the distances to them."""
        area, normal, middle = face_frames(mesh)
        shift = (OFFSET * np.sqrt(area))[:, None] * normal
        outer, inner = middle + shift, middle - shift
        corner, face = mesh.face_vertices, mesh.corner_faces
        total = sum(
            np.bincount(corner, np.linalg.norm(side[face] - mesh.vertices[corner], axis=1))
            for side in (outer, inner)
        )
        return cls(mesh.vertices, total / (2 * np.bincount(corner)), outer, inner)


def train_polygons(
    mesh: PolygonMesh,
    surface: TrueSurface,
    iterations: int,
    weights: Mapping[str, float],
    checkpoints: Checkpoints,
    stored: Mapping[str, Floats | Ints],
    progress: Progress,
    threads: int,
) -> tuple[Paired, Floats]:
    """Spheres and pairs of ``mesh`` after ``iterations`` steps, and the losses ``(iterations, 4)``.

    ``weights``: intersection, exclusion, shape, smooth. ``stored`` goes into every checkpoint.
    """
    state, first, damping = Paired.at(mesh), 0, first_damping(1)
    history = np.zeros((0, len(TERMS)))
    found = checkpoints.latest()
    if found is not None and "outer" in found[1]:
        arrays = found[1]
        state = Paired(*(arrays[item.name] for item in fields(Paired)))
        first, damping = arrays["first"].item(), arrays["damping"]
        history = arrays["history"]
    progress.start("polygons", iterations)
    for begin in range(first, iterations, LEG):
        now: dict[str, Any] = {item.name: getattr(state, item.name) for item in fields(Paired)}
        now |= {"first": begin, "damping": damping, "history": history, **stored}
        checkpoints.save(BEFORE + begin, now.copy)
        last = min(iterations, begin + LEG)
        factors = [EASY if i < START * iterations else 1.0 for i in range(begin, last)]
        problem = PairedProblem(mesh, state, surface, weights, threads)
        state, losses, damping = descend(problem, state, factors, damping)
        history = np.concatenate([history, losses])
        progress.advance(last, f"loss {losses[-1].sum():.4g}")
    return state, history


class PairedProblem:
    """Unknowns ``(c_v, r_v)``, then the outer and the inner generators, with fixed planes."""

    units: Floats | None = None

    def __init__(
        self,
        mesh: PolygonMesh,
        state: Paired,
        surface: TrueSurface,
        weights: Mapping[str, float],
        threads: int,
    ) -> None:
        if not np.isfinite(state.centres).all():
            raise NumericalFailure("a surface vertex is not finite: the training diverged")
        self.mesh, self.weights, self.threads = mesh, weights, threads
        self.count, self.faces = mesh.vertex_count, mesh.face_count
        self.free = np.ones(4 * self.count + 6 * self.faces, dtype=bool)
        # Everything is measured by the faces: their roots of area, and the means of these at the
        # vertices and at the corners of the fans.
        self.size = np.sqrt(face_frames(mesh)[0])
        corner, face = mesh.face_vertices, mesh.corner_faces
        self.reach = np.bincount(corner, self.size[face]) / np.bincount(corner)
        self.laplacian = Laplacian.of(edges(mesh), self.count)
        self.smoothing = np.sqrt(weights["smooth"]) / self.reach
        self.centring = np.sqrt(CENTRED) / self.size
        self.fans, self.triangles = _fans(mesh)
        size = np.concatenate([self.reach, self.size])
        self.shape: list[tuple[Rows, Floats]] = []
        for way in (forward, backward):
            rows = way(surface, self.fans @ state.centres, self.triangles)
            scale = np.sqrt(weights["shape"] * self.count * rows.share)
            self.shape.append((rows, scale / size[rows.corners].mean(axis=1)))

    def prepare(self, state: Paired, factor: float) -> None:
        points = np.concatenate([state.outer, state.inner])
        mesh = self.mesh.with_vertices(state.centres)
        self.near = near_pairs(mesh, points, state.centres, state.radii, SLACK, self.threads)
        _, self.facing, self.middle = face_frames(mesh)
        self.normal = vertex_normals(self.fans @ state.centres, self.triangles)[: self.count]
        both = np.concatenate([self.mesh.face_vertices] * 2)
        self.intersection = np.sqrt(factor * self.weights["intersection"]) / self.reach[both] ** 2
        self.exclusion = np.sqrt(self.weights["exclusion"]) / self.reach[self.near[1]] ** 2
        self.offset = np.sqrt(self.weights["exclusion"]) / self.size

    def residuals(self, state: Paired) -> dict[str, Floats]:
        corner, face = self.mesh.face_vertices, self.mesh.corner_faces
        own = [
            ((side[face] - state.centres[corner]) ** 2).sum(axis=1) - state.radii[corner] ** 2
            for side in (state.outer, state.inner)
        ]
        point, sphere = self.near
        arm = np.concatenate([state.outer, state.inner])[point] - state.centres[sphere]
        power = np.einsum("ij,ij->i", arm, arm) - state.radii[sphere] ** 2
        offset = 0.5 * np.einsum("ij,ij->i", state.outer - state.inner, self.facing)
        bend = self.laplacian(state.centres)
        bend -= np.einsum("ij,ij->i", bend, self.normal)[:, None] * self.normal
        fans = self.fans @ state.centres
        middle = 0.5 * (state.outer + state.inner)
        return {
            "intersection": self.intersection * np.concatenate(own),
            "exclusion": self.exclusion * np.maximum(0.0, MARGIN * self.reach[sphere] ** 2 - power),
            "offset": self.offset * np.maximum(0.0, OFFSET * self.size - offset),
            "shape": np.concatenate([scale * rows.distance(fans) for rows, scale in self.shape]),
            "smooth": (self.smoothing[:, None] * bend).reshape(-1),
            "centred": (self.centring[:, None] * (middle - self.middle)).reshape(-1),
        }

    def moved(self, state: Paired, step: Floats) -> Paired:
        spheres = step[: 4 * self.count].reshape(-1, 4)
        outer, inner = step[4 * self.count :].reshape(2, -1, 3)
        most, furthest = LARGEST_STEP * self.reach, LARGEST_STEP * self.size
        return replace(
            state,
            centres=state.centres + limited(spheres[:, :3], most),
            radii=state.radii + np.clip(spheres[:, 3], -most, most),
            outer=state.outer + limited(outer, furthest),
            inner=state.inner + limited(inner, furthest),
        )

    def energies(self, residuals: dict[str, Floats]) -> Floats:
        return np.array([sum(float(part @ part) for part in residuals.values())])

    def around(self, places: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return places

    def spread(self, values: Floats) -> Floats:
        return np.broadcast_to(values, len(self.free))

    def blocks(self, state: Paired, residuals: dict[str, Floats]) -> list[Block]:
        corner, face = self.mesh.face_vertices, self.mesh.corner_faces
        points = np.concatenate([state.outer, state.inner])
        spheres = np.concatenate([corner, corner])
        columns, values = self._power(
            state, points, np.concatenate([face, self.faces + face]), spheres
        )
        blocks = [
            Block.dense(columns, self.intersection[:, None] * values, residuals["intersection"])
        ]
        row = np.flatnonzero(residuals["exclusion"])
        columns, values = self._power(state, points, self.near[0][row], self.near[1][row])
        blocks.append(
            Block.dense(columns, -self.exclusion[row, None] * values, residuals["exclusion"][row])
        )
        row = np.flatnonzero(residuals["offset"])
        values = -0.5 * self.offset[row, None] * self.facing[row]
        columns = 3 * row[:, None] + np.arange(3)
        columns = 4 * self.count + np.concatenate([columns, columns + 3 * self.faces], axis=1)
        blocks.append(
            Block.dense(columns, np.concatenate([values, -values], 1), residuals["offset"][row])
        )
        axis = np.arange(3 * self.faces)
        blocks.append(
            Block(
                np.concatenate([axis, axis]),
                4 * self.count + np.arange(6 * self.faces),
                0.5 * np.tile(np.repeat(self.centring, 3), 2),
                residuals["centred"],
            )
        )
        blocks.append(self.laplacian.along(self.normal, self.smoothing, residuals["smooth"]))
        return blocks + self._shape(residuals["shape"])

    def _power(
        self, state: Paired, points: Floats, point: Ints, sphere: Ints
    ) -> tuple[Ints, Floats]:
        """Columns and derivatives ``(R, 7)`` of the powers of ``points[point]`` to spheres."""
        arm = points[point] - state.centres[sphere]
        columns = [
            4 * sphere[:, None] + np.arange(4),
            4 * self.count + 3 * point[:, None] + np.arange(3),
        ]
        values = [-2 * arm, -2 * state.radii[sphere, None], 2 * arm]
        return np.concatenate(columns, axis=1), np.concatenate(values, axis=1)

    def _shape(self, residual: Floats) -> list[Block]:
        from scipy.sparse import csr_array

        blocks, done = [], 0
        for rows, scale in self.shape:
            gradient = scale[:, None, None] * rows.gradient()
            places = np.repeat(np.arange(len(scale)), 3), rows.corners.reshape(-1)
            shape = (len(scale), self.fans.shape[0])
            parts = []
            for axis in range(3):
                part = csr_array((gradient[:, :, axis].reshape(-1), places), shape=shape)
                parts.append((part @ self.fans).tocoo())
            blocks.append(
                Block(
                    np.concatenate([part.coords[0] for part in parts]).astype(np.int64),
                    np.concatenate(
                        [4 * part.coords[1].astype(np.int64) + k for k, part in enumerate(parts)]
                    ),
                    np.concatenate([part.data for part in parts]),
                    residual[done : done + len(scale)],
                )
            )
            done += len(scale)
        return blocks


def _fans(mesh: PolygonMesh) -> tuple[Any, Ints]:
    """The map from the vertices to vertices and means of the faces' corners, ``(V + F, V)``, and
    the triangles of the faces fanned about these."""
    from scipy.sparse import csr_array

    count, face = mesh.vertex_count, mesh.corner_faces
    rows = np.concatenate([np.arange(count), count + face])
    columns = np.concatenate([np.arange(count), mesh.face_vertices])
    values = np.concatenate([np.ones(count), 1 / mesh.valences[face]])
    fans = csr_array((values, (rows, columns)), shape=(count + mesh.face_count, count))
    return fans, np.stack([count + face, mesh.face_vertices, mesh.next_vertices], axis=1)
