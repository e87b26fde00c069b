"""Training of triangle faces until their surface is the interface of its own generators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..losses import conforming, shape
from ..surface.edge_table import EdgeTable, Sized
from ..surface.geometry import vertex_normals
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.remesh import delaunay_gain, flip, unfold
from ..surface.spheres import near_pairs
from .loop import Moments

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..contract import Progress
    from ..sources.true_surface import TrueSurface

LEG = 20
"""Iterations between flips of edges, and between checkpoints."""
REFRESH, NEAR_EVERY = 10, 5
"""Iterations between searches for closest points, and for near spheres."""
SLACK = 0.12
"""How much further than a sphere's radius is searched, for what moves in between."""
FIRST_RADIUS = 0.85
"""In target lengths."""
ROUNDS, ROUND = 16, 80
"""The most rounds of repair, and the iterations of one."""
ROUND_RATE = 0.004
"""First step of a round of repair."""
RELEASE = 0.4
"""Factor to the shape's weight around an intruder, in each round in which it stays."""
RADII = (0.55, 0.9)
"""Radii around an intruder are brought back to these limits, in target lengths."""
RINGS = 3
"""Rings of vertices around an intruder's that move in a round."""
STRICT = 4.0
"""Factor to the weight of exclusion in the rounds of repair."""
SAFE = 1e-4
"""Smallest power, in units of h0^2, that lets a generator pass as outside a sphere."""

TERMS = ("intersection", "exclusion", "shape", "normal")


@dataclass(frozen=True)
class Spheres:
    """A triangle surface with spheres at its vertices, in model units."""

    centres: Floats
    radii: Floats
    triangles: Ints
    lengths: Floats
    """Target length at each vertex."""

    @classmethod
    def at(cls, vertices: Floats, triangles: Ints, lengths: Floats) -> Spheres:
        return cls(vertices, FIRST_RADIUS * lengths, triangles, lengths)

    def pairs(self) -> tuple[Floats, Floats, Floats]:
        """Generators ``(2F, 3)``, outer ones first; delta^2 ``(F,)``; normals ``(F, 3)``."""
        pairs = conforming.radical_pairs(
            *(torch.as_tensor(part) for part in (self.centres, self.radii, self.triangles))
        )
        floor = conforming.SMALLEST_SQUARE * self._face_lengths() ** 2
        points = pairs.points(torch.as_tensor(floor))
        return points.numpy(), pairs.square.numpy(), pairs.normal.numpy()

    def _face_lengths(self) -> Floats:
        return np.asarray(self.lengths[self.triangles].mean(axis=1))

    def intruded(self, threads: int) -> NDArray[np.bool_]:
        """Vertices whose sphere holds a generator not its own, or a triangle without a pair."""
        points, square, _ = self.pairs()
        mesh = PolygonMesh.of_triangles(self.centres, self.triangles)
        point, sphere = near_pairs(mesh, points, self.centres, self.radii, 0.02, threads)
        power = ((points[point] - self.centres[sphere]) ** 2).sum(axis=1)
        power -= self.radii[sphere] ** 2
        found = np.zeros(len(self.centres), dtype=bool)
        found[sphere[power < SAFE]] = True
        found[self.triangles[square <= conforming.SMALLEST_SQUARE * self._face_lengths() ** 2]] = 1
        return found


@dataclass(frozen=True)
class Leg:
    """How one phase of the training goes."""

    iterations: int
    rate: float
    weights: Mapping[str, float]


def conform(
    start: Spheres,
    surface: TrueSurface,
    first: Leg,
    checkpoints: Checkpoints,
    progress: Progress,
    threads: int,
) -> tuple[Spheres, Floats, int]:
    """Train ``start``, then repair what does not conform, ring by ring.

    Where an intruder stays, the pull to the true surface is let go by and by, until there is room
    for the spheres. Returns the spheres, the history ``(iterations, 4)`` of the unweighted losses
    of the first phase and the number of rounds.
    """
    found = checkpoints.latest()
    spheres, round_number, history = start, 0, np.zeros((0, len(TERMS)))
    hold, state, begin = np.ones(len(start.centres)), None, 0
    if found is not None:
        _, state = found
        spheres = Spheres(*(state[name] for name in ("centres", "radii", "triangles", "lengths")))
        hold, history = state["hold"], state["history"]
        round_number, begin = int(state["round"]), int(state["begin"])
    strict = replace(
        first,
        iterations=ROUND,
        rate=ROUND_RATE,
        weights={**first.weights, "exclusion": STRICT * first.weights["exclusion"]},
    )
    while True:
        free = np.ones(len(hold), dtype=bool)
        if round_number:
            if state is None:
                intruded = spheres.intruded(threads)
                if not intruded.any() or round_number > ROUNDS:
                    break
                intruded = _rings(spheres.triangles, intruded, 1 + round_number // 4)
                hold = np.where(intruded, RELEASE * hold, hold)
                spheres = _settled(spheres, intruded)
                free = _rings(spheres.triangles, intruded, RINGS)
            else:
                free = state["free"].astype(bool)
        store = {"hold": hold, "free": free, "round": np.array(round_number)}
        before = first.iterations + ROUND * (round_number - 1) if round_number else 0
        leg = strict if round_number else first
        label = f"repair {round_number}" if round_number else "sphere-train"
        progress.start(label, leg.iterations)
        training = _Training(spheres, surface, leg, hold, free, before, threads)
        spheres, history = training.run(checkpoints, progress, store, history, begin, state)
        round_number, state, begin = round_number + 1, None, 0
    return spheres, history, round_number - 1


def _rings(triangles: Ints, marked: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """``marked (V,)`` grown by rings of neighbouring vertices."""
    for _ in range(rings):
        grown = marked.copy()
        grown[triangles[marked[triangles].any(axis=1)]] = True
        marked = grown
    return marked


def _settled(spheres: Spheres, marked: NDArray[np.bool_]) -> Spheres:
    """Folds undone, and the radii of the marked vertices within limits."""
    mesh = Sized(spheres.centres.copy(), spheres.triangles, spheres.lengths)
    unfold(mesh)
    low, high = (limit * spheres.lengths for limit in RADII)
    radii = np.where(marked, np.clip(spheres.radii, low, high), spheres.radii)
    return replace(spheres, centres=mesh.vertices, radii=radii)


class _Training:
    """One phase: Adam on ``(u_v, log(r_v / l_v))`` with ``c_v = start + l_v u_v``."""

    def __init__(
        self,
        spheres: Spheres,
        surface: TrueSurface,
        leg: Leg,
        hold: Floats,
        free: NDArray[np.bool_],
        before: int,
        threads: int,
    ) -> None:
        self.spheres, self.surface, self.leg = spheres, surface, leg
        self.hold, self.threads, self.before = hold, threads, before
        self.triangles = spheres.triangles
        self.length = torch.as_tensor(spheres.lengths)
        self.start = torch.as_tensor(spheres.centres)
        self.free = None if free.all() else torch.as_tensor(free).double()
        shift = torch.zeros_like(self.start).requires_grad_(True)
        size = torch.log(torch.as_tensor(spheres.radii) / self.length).requires_grad_(True)
        self.parameters = {"shift": shift, "size": size}
        self.moments = Moments(self.parameters)

    def _values(self) -> tuple[torch.Tensor, torch.Tensor]:
        centres = self.start + self.length[:, None] * self.parameters["shift"]
        return centres, self.length * torch.exp(self.parameters["size"])

    def run(
        self,
        checkpoints: Checkpoints,
        progress: Progress,
        store: dict[str, np.ndarray],
        history: Floats,
        begin: int,
        state: Mapping[str, np.ndarray] | None,
    ) -> tuple[Spheres, Floats]:
        if state is not None:
            self.moments.restore(state)
            self.triangles = state["now"]
        for iteration in range(begin, self.leg.iterations):
            if iteration % LEG == 0:
                if iteration:
                    self._flip()
                if iteration > begin:
                    self._save(checkpoints, store, history, iteration)
                self._connect()
            terms = self._losses(iteration)
            weights = self.leg.weights
            total = torch.stack([weights[key] * terms[key] for key in weights]).sum()
            gradients = list(torch.autograd.grad(total, list(self.parameters.values())))
            row = [float(terms[key].detach()) for key in TERMS]
            if not np.isfinite(row).all() or not all(
                bool(gradient.isfinite().all()) for gradient in gradients
            ):
                raise NumericalFailure(
                    f"sphere-train: a loss or gradient is not finite at iteration {iteration}; "
                    "lower --learning-rate"
                )
            if not store["round"]:
                history = np.concatenate([history, [row]])
            if self.free is not None:
                gradients = [gradients[0] * self.free[:, None], gradients[1] * self.free]
            decay = 0.5 * (1 + math.cos(math.pi * iteration / self.leg.iterations))
            self.moments.step(gradients, iteration, self.leg.rate * decay)
            progress.advance(iteration + 1, f"loss {float(total.detach()):.4g}")
        centres, radii = (value.detach().numpy() for value in self._values())
        return replace(
            self.spheres, centres=centres, radii=radii, triangles=self.triangles
        ), history

    def _save(
        self, checkpoints: Checkpoints, store: dict[str, np.ndarray], history: Floats, at: int
    ) -> None:
        whole = {name: getattr(self.spheres, name) for name in Spheres.__dataclass_fields__}
        number = self.before + at
        extra = {"history": history, "begin": np.array(at), "now": self.triangles}
        checkpoints.save(number, {**whole, **store, **extra, **self.moments.as_arrays()})

    def _flip(self) -> None:
        mesh = Sized(self._values()[0].detach().numpy(), self.triangles, self.spheres.lengths)
        flip(mesh, delaunay_gain)
        self.triangles = mesh.triangles

    def _connect(self) -> None:
        table = EdgeTable.of(self.triangles)
        self.corners = torch.as_tensor(self.triangles)
        self.ends = torch.as_tensor(table.ends)
        self.sides = torch.as_tensor(table.triangles)
        self.degree = torch.bincount(self.ends.reshape(-1), minlength=len(self.start)).double()
        self.face_length = self.length[self.corners].mean(1)
        hold = np.concatenate([self.hold, self.hold[self.triangles].min(axis=1)])
        self.sample_weight = torch.as_tensor(hold)
        self.sample_length = torch.cat([self.length, self.face_length])

    def _losses(self, iteration: int) -> dict[str, torch.Tensor]:
        centres, radii = self._values()
        pairs = conforming.radical_pairs(centres, radii, self.corners)
        points = pairs.points(conforming.SMALLEST_SQUARE * self.face_length**2)
        middles = centres.index_select(0, self.corners.reshape(-1)).reshape(-1, 3, 3).mean(1)
        samples = torch.cat([centres, middles])
        at = centres.detach().numpy()
        if iteration % REFRESH == 0:
            faces = pairs.normal.detach().numpy()
            normals = np.concatenate([vertex_normals(at, self.triangles), faces])
            self.planes = shape.tangent_planes(self.surface, samples, normals)
        if iteration % NEAR_EVERY == 0:
            near = near_pairs(
                PolygonMesh.of_triangles(at, self.triangles),
                points.detach().numpy(), at, radii.detach().numpy(), SLACK, self.threads,
            )  # fmt: skip
            self.near = [torch.as_tensor(index) for index in near]
        distance = shape.to_planes(samples, self.planes) / self.sample_length
        bend = conforming.umbrella(centres, self.ends, self.degree) / self.length[:, None]
        size = torch.exp(self.parameters["size"])[:, None]
        left, right = (pairs.normal.index_select(0, self.sides[:, k]) for k in range(2))
        return {
            "intersection": conforming.existence(pairs, self.face_length),
            "exclusion": conforming.exclusion(points, centres, radii, self.length, *self.near),
            "shape": (self.sample_weight * distance**2).mean(),
            "normal": (1 - (left * right).sum(1)).mean(),
            "smooth": (bend**2).sum(1).mean(),
            "radius": (conforming.umbrella(size, self.ends, self.degree) ** 2).mean(),
        }
