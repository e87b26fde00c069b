"""From the initial surface to trained triangles: remeshed, fitted, made to conform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

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


def train_triangles(
    context: Context,
    edge_length: float,
    weights: Mapping[str, float],
    iterations: int,
) -> Trained:
    """The surface of stage init, or the input's if that has not its topology, remeshed with edges
    of ``edge_length`` h0 and trained by ``iterations`` steps and as many repairs as it needs."""
    frame, surface = ModelFrame.of(context.arrays("classify")), context.surface
    first = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    expected, given = context.source().topology(), topology(first)
    from_input = expected not in (None, (given.euler_number, given.components))
    if from_input:
        # What follows keeps the topology that it starts with.
        first = context.source().manifold()
    first = first.with_vertices(frame.model_from_input(first.vertices))
    length = for_surface(surface.samples, surface.normals, edge_length)
    start = remesh(*fan_triangles(first)[:2], length, surface)
    spheres, history, rounds = conform(
        start, surface, Leg(iterations, weights), context.checkpoints, context.progress,
        context.threads,
    )  # fmt: skip
    return Trained(spheres, history, rounds, from_input)
