"""From the initial surface to trained triangles: remeshed, fitted, made to conform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..sources.creases import found
from ..surface.creases import Creases, deviation
from ..surface.geometry import fan_triangles
from ..surface.model_frame import ModelFrame
from ..surface.polygons import Floats, PolygonMesh
from ..surface.remesh import remesh
from ..surface.sizing import for_surface
from ..surface.topology import topology
from .conforming import Leg, conform
from .spheres import Spheres

if TYPE_CHECKING:
    from ..contract import Context


@dataclass(frozen=True)
class Trained:
    """Trained triangles, the losses of their training, and how it went."""

    spheres: Spheres
    history: Floats
    rounds: int
    from_input: bool
    """Whether the input's own triangles were remeshed, not the initial surface."""
    creases: Creases | None
    """What the input has of creases, if they were looked for and there are any."""
    missed: int
    """Creases between corners that no edges follow."""

    def facts(self) -> dict[str, Any]:
        """How it went, for the manifest."""
        facts = started(self.rounds, self.from_input)[0]
        if self.creases is not None:
            spheres = self.spheres
            facts["creases"] = {
                "chains": len(self.creases.chains),
                "missed": self.missed,
                "corners": len(self.creases.corners),
                "length_in_h": sum(chain.length for chain in self.creases.chains),
                **deviation(self.creases, spheres.centres, spheres.rank, spheres.creases),
            }
        return facts

    def warnings(self) -> list[str]:
        said = started(self.rounds, self.from_input)[1]
        if self.missed and self.creases is not None:
            said.append(
                f"{self.missed} of {len(self.creases.chains)} creases are not followed by edges: "
                "raise -n, or lower --edge-length"
            )
        return said


def started(rounds: int, from_input: bool) -> tuple[dict[str, Any], list[str]]:
    """What the manifest says of a training's start, and what the user is warned of."""
    facts = {"repair_rounds": rounds, "started_from": "input" if from_input else "init"}
    said = "the initial surface has not the input's topology: the input's triangles were remeshed"
    return facts, [said] if from_input else []


def train_triangles(
    context: Context,
    edge_length: float,
    weights: Mapping[str, float],
    iterations: int,
    angle: float | None = None,
) -> Trained:
    """The surface of stage init, or the input's if that has not its topology, remeshed with edges
    of ``edge_length`` h0 and trained by ``iterations`` steps and as many repairs as it needs.

    Edges follow the creases that turn by ``angle`` degrees or more; None lets them go.
    """
    frame, surface = ModelFrame.of(context.arrays("classify")), context.surface
    first = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    expected, given = context.source().topology(), topology(first)
    from_input = expected not in (None, (given.euler_number, given.components))
    if from_input:
        # What follows keeps the topology that it starts with.
        first = context.source().manifold()
    first = first.with_vertices(frame.model_from_input(first.vertices))
    length = for_surface(surface.samples, surface.normals, edge_length)
    chains = [] if angle is None else found(context.source(), frame, angle)
    creases = Creases(chains) if chains else None
    start, missed = remesh(*fan_triangles(first)[:2], length, surface, creases)
    spheres, history, rounds = conform(
        start, surface, creases, Leg(iterations, weights), context.checkpoints, context.progress,
        context.threads,
    )  # fmt: skip
    return Trained(spheres, history, rounds, from_input, creases, missed)
