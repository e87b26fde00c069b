"""Training of triangles: the first surface is remeshed, fitted, and made to conform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import NumericalFailure
from ..mesh.creases import Creases, deviation
from ..mesh.geometry import fan_triangles
from ..mesh.model_frame import ModelFrame
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.queries.intersections import self_intersections
from ..mesh.queries.thickness import thickness
from ..mesh.topology import topology
from ..remesh.fitting import vertex_errors
from ..remesh.target_lengths import Spacing, TooManyTriangles, distinct, spaced
from ..solvers.gauss_newton import TERMS, first_damping
from .conforming import ROUND, Leg, conform
from .refinement import MOST, Refine, refined
from .spheres import Spheres

if TYPE_CHECKING:
    from ..engine.stage import Context


FOLLOWED = 0.8
"""A crease counts as followed if its edges have this share of its length. Edges are chords, so that
those of a small circle are shorter than it."""
MISSED = 0.05
"""Relative deviation from the wanted number of triangles above which there is a warning."""


@dataclass(frozen=True)
class Trained:
    """The trained triangles, the losses, and facts about the training."""

    spheres: Spheres
    history: Floats
    rounds: int
    from_input: bool
    """Whether the triangles of the input were remeshed, and not the first surface."""
    creases: Creases | None
    """The creases of the input, if they were sought and it has any."""
    missed: int
    """Number of creases between corners that no edges follow."""
    refinement: dict[str, Any] | None
    """Facts about the refinement, if there was one."""
    asked: int | None
    """The wanted number of triangles, if one was given."""
    refinements: int = 0
    """Number of rounds of refinement."""

    def stored(self) -> dict[str, Any]:
        """What a checkpoint of a later phase must store so that this phase is not repeated."""
        count = len(self.spheres.centres)
        state = {item.name: getattr(self.spheres, item.name) for item in fields(Spheres)}
        return state | {
            "round": 1, "begin": 0, "damping": first_damping(count),
            "free": np.ones(count, dtype=bool), "history": self.history, "missed": self.missed,
            "refined": self.refinements, "repairs": self.rounds,
        }  # fmt: skip

    @property
    def given_up(self) -> int:
        """Number of creases that edges followed at first, and in the end only in part.

        Where they prevented the certificate, the surface was made round.
        """
        if self.creases is None:
            return 0
        start, end, chain = self.spheres.creases.T
        way = self.spheres.centres[end] - self.spheres.centres[start]
        chains = self.creases.chains
        followed = np.bincount(chain, np.linalg.norm(way, axis=1), minlength=len(chains))
        whole = np.array([chain.length for chain in chains])
        return max(0, int((followed < FOLLOWED * whole).sum()) - self.missed)

    def facts(self) -> dict[str, Any]:
        """The figures for the manifest."""
        facts = started(self.rounds, self.from_input)
        if self.creases is not None:
            spheres = self.spheres
            facts["creases"] = {
                "chains": len(self.creases.chains),
                "missed": self.missed,
                "given_up": self.given_up,
                "corners": len(self.creases.corners),
                "length_in_h": sum(chain.length for chain in self.creases.chains),
                **deviation(self.creases, spheres.centres, spheres.rank, spheres.creases),
            }
        if self.refinement is not None:
            facts["refinement"] = self.refinement
        return facts

    def warnings(self) -> list[str]:
        """The warnings for the manifest."""
        said = []
        if self.missed and self.creases is not None:
            said.append(
                f"edges do not follow {self.missed} of {len(self.creases.chains)} "
                "creases, so these are rounded: raise -n, or lower --edge-length"
            )
        if self.given_up and self.creases is not None:
            said.append(
                f"edges follow {self.given_up} of {len(self.creases.chains)} creases "
                "in part only, since the rest prevented the certificate and is "
                "rounded: raise -n, or lower --edge-length"
            )
        count = len(self.spheres.triangles)
        if self.asked and self.refinement is None and abs(count / self.asked - 1) > MISSED:
            said.append(
                f"--faces-target {self.asked}: the surface has {count} triangles, "
                "since thin parts, creases, --spacing-min or --spacing-max allow no "
                "other number"
            )
        if self.refinement is not None and not self.refinement["within"]:
            said.append(
                f"--refine: triangles are still up to {self.refinement['largest']:.3g} "
                f"h0 from the shape after {self.refinement['rounds']} rounds: raise "
                "--faces-target or --refine"
            )
        return said


def started(rounds: int, from_input: bool) -> dict[str, Any]:
    """The figures for the manifest about the start and the repairs of a training."""
    return {"repair_rounds": rounds, "started_from": "input" if from_input else "init"}


def train_triangles(
    context: Context,
    spacing: Spacing,
    weights: Mapping[str, float],
    iterations: int,
    angle: float | None = None,
    refine: Refine | None = None,
) -> Trained:
    """Remesh the first surface as ``spacing`` says, and train it.

    That is the input's own surface if it is closed and does not cross itself, else the one of the
    init stage. There are ``iterations`` steps, and as many repairs as needed. Edges follow creases
    that turn by ``angle`` degrees or more; None follows none. With ``refine``, triangles that are
    then too far from the shape are divided and trained again. Raises NumericalFailure if the shape
    needs more triangles than ``spacing`` allows.
    """
    frame, surface = ModelFrame.of(context.arrays("classify")), context.surface
    vertices, corners, from_input, exact = _first(context, frame)
    chains = [] if angle is None else context.source().creases(surface, frame, angle)
    creases = Creases(chains) if chains else None
    found = context.checkpoints.latest()
    if found is None:
        try:
            start, missed = spaced(vertices, corners, surface, creases, spacing, exact)
        except TooManyTriangles as error:
            raise NumericalFailure(_too_many(error, frame, spacing)) from error
        spheres, history = Spheres.at(start), np.zeros((0, len(TERMS)))
        free = np.ones(len(spheres.centres), dtype=bool)
        times = repairs = 0
    else:
        spheres, history = Spheres.stored(found[1]), found[1]["history"]
        free = found[1]["free"].astype(bool)
        missed, times, repairs = (found[1][key].item() for key in ("missed", "refined", "repairs"))
    while True:
        spheres, history, rounds = conform(
            spheres, free, history, surface, creases,
            Leg(ROUND if times else iterations, weights),
            {"missed": missed, "refined": times, "repairs": repairs},
            context.checkpoints, context.progress, context.threads,
        )  # fmt: skip
        repairs += rounds
        further = None
        if refine is not None and times < MOST:
            further = refined(spheres, surface, creases, refine)
        if further is None:
            break
        (spheres, free), times = further, times + 1
    facts = None
    if refine is not None:
        _, far = vertex_errors(surface, spheres.centres, spheres.triangles)
        largest = float(far.max())
        facts = {"rounds": times, "bound": refine.bound, "largest": largest,
                 "within": largest <= refine.bound}  # fmt: skip
    return Trained(
        spheres, history, repairs, from_input, creases, missed, facts, spacing.faces, times
    )


def _first(context: Context, frame: ModelFrame) -> tuple[Floats, Ints, bool, bool]:
    """The vertices, in model units, and triangles to start from.

    The other two values say whether they are those of the input, and whether no two of these cross.
    The training keeps the topology that it starts with. The input's own triangles have the right
    one if they are closed and do not cross; otherwise the first surface may have it.
    """
    source = context.source()
    expected = source.topology()
    initial = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    given = topology(initial)
    if expected is not None:
        own = source.manifold()
        vertices, triangles = fan_triangles(own)[:2]
        vertices = frame.model_from_input(vertices)
        agrees = expected == (given.euler_number, given.components)
        exact = len(self_intersections(vertices, triangles)) == 0
        if exact or not agrees:
            return vertices, triangles, True, exact
    vertices, triangles = fan_triangles(initial)[:2]
    return frame.model_from_input(vertices), triangles, False, False


def resisting(spheres: Spheres, frame: ModelFrame, threads: int) -> str:
    """A sentence about spheres that contain generators of other faces.

    It names the worst places, in the coordinates of the input, and the thickness there.
    """
    depth = spheres.intrusion(threads)
    if not depth.any():
        return (
            "no generator lies in the sphere of another face, but a triangle has no area "
            "or lies on the wrong side"
        )
    worst = distinct(spheres.centres, -depth, depth > 0)
    at = frame.input_from_model(spheres.centres[worst])
    owner = np.array([np.flatnonzero((spheres.triangles == vertex).any(axis=1))[0]
                      for vertex in worst], np.int64)  # fmt: skip
    thick = frame.spacing * thickness(spheres.centres, spheres.triangles, owner)
    named = [
        f"({', '.join(f'{x:.6g}' for x in place)})"
        + (f", {thin:.3g} thick" if np.isfinite(thin) else "")
        for place, thin in zip(at, thick, strict=True)
    ]
    return (
        f"generators of other faces lie in {int((depth > 0).sum())} of {len(depth)} "
        f"spheres, worst at {'; '.join(named)}"
    )


def _too_many(error: TooManyTriangles, frame: ModelFrame, spacing: Spacing) -> str:
    return (
        f"the shape needs about {error.demand.triangles:,.0f} triangles, more than --max-faces "
        f"{spacing.most}, since the shape or its gaps are thin: {error.demand.named(frame)}; raise "
        "--max-faces, or make it thicker"
    )
