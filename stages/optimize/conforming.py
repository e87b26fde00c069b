"""Training of triangle faces until their surface is the interface of its own generators.

The unknowns are the spheres; the generators follow in closed form. Damped Gauss-Newton steps bring
the surface to the true one while no generator may enter a sphere that is not its own; what resists
is mended in rounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..losses import conforming
from ..surface.edge_table import EdgeTable, Sized
from ..surface.geometry import vertex_normals
from ..surface.operations import contract_short, delaunay_gain, flip
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.remesh import astray, keeping, unfold
from ..surface.sheets import part
from ..surface.spheres import near_pairs
from .fitting import Rows, backward, forward
from .least_squares import Block, Normal

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..contract import Progress
    from ..sources.true_surface import TrueSurface

LEG = 5
"""Steps between flips of edges, searches for closest points, and checkpoints."""
SLACK = 0.15
"""How much further than a sphere's radius is searched, for what moves in a step."""
FIRST_RADIUS = 0.8
"""In target lengths."""
RADII = (0.3, 1.3)
"""Limits of the radii, in target lengths."""
OFFSET = 0.5
"""``delta_f`` below which a pair is penalised, in target lengths."""
SMALLEST = 0.1
"""``delta_f`` that stands for a missing pair while there is none, in target lengths."""
MARGIN = 0.02
"""Power below which a generator that is not a sphere's own is penalised, in target lengths
squared."""
SAFE = 1e-4
"""Smallest power, in units of h0^2, that lets a generator pass as outside a sphere."""
LARGEST_STEP = 0.12
"""Of a centre or radius, in target lengths."""
DAMPING = 1e-2, 1e-4
"""The first and the smallest."""
EASIER, HARDER, TRIALS = 3.0, 5.0, 4
"""What the damping is divided by after a step that lowers the sum of squares, what it is
multiplied with after one that does not, and how often that is tried."""
ROUNDS, ROUND = 24, 6
"""The most rounds of repair, and the steps of one."""
STRICT = 4.0
"""Factor to the weights of what conformity needs in the rounds of repair."""
PATIENCE = 2
"""Rounds in which only edges are contracted and flipped, before the surface is let go."""
RELEASE, LOOSEST = 0.3, 0.003
"""Factor to the shape's weight around an intruder in each later round, and the least it becomes."""
SETTLED = (0.55, 0.9)
"""Radii around an intruder are brought back to these limits, in target lengths."""
RINGS = 3
"""Rings of vertices around an intruder's that move in a round."""
SHORT = 0.5
"""Edges around an intruder shorter than this are contracted, in target lengths."""

TERMS = ("intersection", "exclusion", "shape", "normal")


@dataclass(frozen=True)
class Spheres:
    """A triangle surface with spheres at its vertices, in model units."""

    centres: Floats
    radii: Floats
    triangles: Ints
    lengths: Floats
    """Target length at each vertex."""
    hold: Floats
    """Share of the shape's weight at each vertex."""
    age: Floats
    """Rounds of repair in which each vertex was at an intruder."""

    @classmethod
    def at(cls, mesh: Sized) -> Spheres:
        radii = FIRST_RADIUS * mesh.length
        ones = np.ones_like(radii)
        return cls(mesh.vertices, radii, mesh.triangles, mesh.length, ones, 0 * ones)

    @property
    def face_lengths(self) -> Floats:
        return np.asarray(self.lengths[self.triangles].mean(axis=1))

    def pairs(self) -> conforming.Pairs:
        return conforming.radical_pairs(self.centres, self.radii, self.triangles)

    def generators(self) -> tuple[Floats, Floats]:
        """Generators ``(2F, 3)``, outer ones first, and delta^2 ``(F,)``."""
        pairs = self.pairs()
        return pairs.points((SMALLEST * self.face_lengths) ** 2), pairs.square

    def intruded(self, threads: int) -> NDArray[np.bool_]:
        """Vertices whose sphere holds a generator not its own, or a triangle without a pair."""
        points, square = self.generators()
        mesh = PolygonMesh.of_triangles(self.centres, self.triangles)
        point, sphere = near_pairs(mesh, points, self.centres, self.radii, 0.02, threads)
        power = ((points[point] - self.centres[sphere]) ** 2).sum(axis=1) - self.radii[sphere] ** 2
        found = np.zeros(len(self.centres), dtype=bool)
        found[sphere[power < SAFE]] = True
        found[self.triangles[square <= (SMALLEST * self.face_lengths) ** 2]] = True
        return found

    def as_mesh(self) -> Sized:
        """Centres, triangles and lengths; radii and holds are carried along."""
        carried = np.stack([self.radii, self.hold, self.age], axis=1)
        return Sized(self.centres, self.triangles, self.lengths, carried)

    @classmethod
    def of_mesh(cls, mesh: Sized) -> Spheres:
        radii, hold, age = mesh.carried.T[:3]
        return cls(mesh.vertices, radii, mesh.triangles, mesh.length, hold, age)


@dataclass(frozen=True)
class Leg:
    """How many steps, and the weights of the terms; lengths are in units of the target length."""

    iterations: int
    weights: Mapping[str, float]
    """intersection and exclusion: a pair, or a generator and a sphere, each; shape: a vertex's
    part of the surface; normal, smooth and radius: a vertex."""


def conform(
    start: Sized,
    surface: TrueSurface,
    leg: Leg,
    checkpoints: Checkpoints,
    progress: Progress,
    threads: int,
) -> tuple[Spheres, Floats, int]:
    """Train the spheres at the vertices of ``start``, then repair what does not conform.

    In a round of repair short edges around the intruders are contracted, and where that does not
    help the pull to the true surface is let go by and by, until there is room for the spheres.
    Returns the spheres, the history ``(iterations, 4)`` of the losses (TERMS) before the repair and
    the number of rounds. Raises NumericalFailure when a value is not finite.
    """
    spheres, number, begin, damping = Spheres.at(start), 0, 0, DAMPING[0]
    history, free = np.zeros((0, len(TERMS))), np.ones(len(start.vertices))
    found = checkpoints.latest()
    if found is not None:
        state = found[1]
        spheres = Spheres(*(state[name] for name in Spheres.__dataclass_fields__))
        number, begin, damping = (state[name].item() for name in ("round", "begin", "damping"))
        history, free = state["history"], state["free"]
    strict = {key: STRICT * leg.weights[key] for key in ("intersection", "exclusion")}
    while True:
        if number and begin == 0:
            intruded = spheres.intruded(threads)
            if not intruded.any() or number > ROUNDS:
                return spheres, history, number - 1
            spheres, free = _mended(spheres, intruded, surface)
            damping = DAMPING[0]
        count = ROUND if number else leg.iterations
        weights = {**leg.weights, **strict} if number else leg.weights
        progress.start(f"repair {number}" if number else "sphere-train", count)
        for first in range(begin, count, LEG):
            if first or number:
                state = {
                    **{name: getattr(spheres, name) for name in Spheres.__dataclass_fields__},
                    "round": np.array(number),
                    "begin": np.array(first),
                    "free": free,
                    "damping": np.array(damping),
                    "history": history,
                }
                checkpoints.save(leg.iterations * min(number, 1) + ROUND * number + first, state)
            last = min(count, first + LEG)
            ramp = [1.0 if number else min(1.0, 2 * (i + 1) / count) for i in range(first, last)]
            legs = _Steps(spheres, surface, weights, free, threads)
            spheres, losses, damping = legs.run(ramp, damping)
            if not number:
                history = np.concatenate([history, losses])
            progress.advance(last, f"loss {losses[-1].sum():.4g}")
        number, begin = number + 1, 0


def _rings(triangles: Ints, marked: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """``marked (V,)`` grown by rings of neighbouring vertices."""
    for _ in range(rings):
        grown = marked.copy()
        grown[triangles[marked[triangles].any(axis=1)]] = True
        marked = grown
    return marked


def _mended(
    spheres: Spheres, intruded: NDArray[np.bool_], surface: TrueSurface
) -> tuple[Spheres, Floats]:
    """Spheres with better triangles, and more room around the intruders, and which vertices may
    move, ``(V,)``."""
    triangles = spheres.triangles
    wrong = intruded.copy()
    wrong[triangles[astray(spheres.as_mesh(), surface)]] = True
    age = np.where(_rings(triangles, wrong, 1), spheres.age + 1, spheres.age)
    near = _rings(triangles, wrong, 1)
    old = wrong & (age > PATIENCE)
    let_go = _rings(triangles, old, 1) | _rings(triangles, wrong & (age > 2 * PATIENCE), 2)
    hold = np.where(
        let_go, np.minimum(spheres.hold, np.maximum(RELEASE * spheres.hold, LOOSEST)), spheres.hold
    )
    low, high = (limit * spheres.lengths for limit in SETTLED)
    radii = np.where(near, np.clip(spheres.radii, low, high), spheres.radii)
    mesh = replace(spheres, radii=radii, hold=hold, age=age).as_mesh()
    free = _rings(triangles, wrong, RINGS) | _rings(triangles, old, 2 * RINGS)
    mesh.carried = np.concatenate([mesh.carried, free[:, None]], axis=1)
    if old.any():
        part(mesh, _rings(triangles, old, RINGS))
    contract_short(mesh, SHORT, near)
    flip(mesh, keeping(surface, delaunay_gain))
    unfold(mesh, surface)
    return Spheres.of_mesh(mesh), mesh.carried[:, 3]


class _Steps:
    """Damped Gauss-Newton steps on ``(c_v, r_v)`` with fixed triangles and planes."""

    def __init__(
        self,
        spheres: Spheres,
        surface: TrueSurface,
        weights: Mapping[str, float],
        free: Floats,
        threads: int,
    ) -> None:
        mesh = spheres.as_mesh()
        flip(mesh, keeping(surface, delaunay_gain))
        self.spheres = replace(spheres, triangles=mesh.triangles)
        self.weights, self.threads = weights, threads
        self.free = np.repeat(free, 4)
        self.length, self.face_length = self.spheres.lengths, self.spheres.face_lengths
        centres, triangles = self.spheres.centres, mesh.triangles
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
            normal = Normal(self._blocks(spheres, residuals), 4 * count)
            for _ in range(TRIALS):
                moved = self._moved(spheres, normal.step(damping, self.free))
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
            * np.maximum(0.0, MARGIN - power / self.length[sphere] ** 2),
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
