"""Stage baseline: run another published method on the same input.

Example:
    >>> from vorolight.stages import baseline
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "baseline", baseline.Params("voromesh"))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from . import torch_start
from .engine.params import Positional, Positive, Range, StageParams
from .engine.stage import Context, Outcome, Stage
from .errors import InputError
from .memory import peak

if TYPE_CHECKING:
    from .baselines.voromesh import CubeFrame
    from .inputs.source import Source
    from .mesh.polygons import Floats

SAMPLES = 150
"""Number of samples divided by the square of the grid's nodes along a side: 153,600 samples at
32."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the baseline stage."""

    method: Annotated[Literal["voromesh"], Positional()] = "voromesh"
    """The method: VoroMesh (Maruani et al., ICCV 2023), with its published settings."""
    grid: Annotated[int, Range(4, 512)] = 32
    """Number of nodes along a side of the cube around the shape. Nodes near the shape are the first
    generators."""
    samples: Annotated[int, Range(100, 10_000_000)] | None = None
    """Number of points on the surface. Default: 150 times the square of --grid, 153,600 at 32. A
    point cloud gives its own points, at most this number."""
    epochs: Annotated[int, Range(0, 100_000)] = 400
    """Number of Adam iterations."""
    batch: Annotated[float, Range(1e-3, 1)] = 0.2
    """Share of the samples that each epoch uses; they are drawn anew."""
    learning_rate: Positive = 5e-3
    """First step of Adam, where the edge of the cube is 2. It is halved after 20, 37.5, 50 and 62.5
    % of the epochs."""
    labels: str | None = None
    """A mesh file or built-in field that decides what is inside, such as the clean mesh of a noisy
    point cloud. Default: the input."""


def run(context: Context) -> Outcome:
    """Sample the surface, place generators, train them by Adam on the VoroLoss, label them, and
    extract the interface."""
    from concurrent.futures import ThreadPoolExecutor

    import torch

    from .baselines import voromesh
    from .formats import ply
    from .mesh.topology import topology
    from .metrics import watertight
    from .solvers.adam import Schedule, adam
    from .voronoi.diagram.interface import interface

    torch_start.start(context.threads)
    params = context.params
    source = context.source()
    judge = _judge(context)
    samples, frame = _samples(context, source)
    start = voromesh.first_generators(samples, params.grid)
    generators = torch.tensor(start).requires_grad_(True)

    with ThreadPoolExecutor(context.threads) as pool:

        def losses(epoch: int) -> dict[str, torch.Tensor]:
            with torch.no_grad():
                generators.clamp_(-1.0, 1.0)
            chosen = context.random("batch", epoch).random(len(samples)) < params.batch
            batch = samples[chosen] if chosen.any() else samples
            return {"voronoi": voromesh.differentiable(generators, batch, params.grid, pool)}

        history = adam(
            {"generators": generators},
            losses,
            {"voronoi": 1.0},
            Schedule(
                params.epochs, params.learning_rate, "halving", 10, halvings=voromesh.MILESTONES
            ),
            context.checkpoints,
            context.progress,
            "baseline",
        )
    places = voromesh.bounded(generators.detach().numpy().clip(-1.0, 1.0), context.random("jitter"))
    inside = voromesh.labels(places, lambda points: judge.inside(frame.input_from_cube(points)))
    if not inside.any():
        of = context.folder.path if params.labels is None else params.labels
        raise InputError(
            f"{of}: none of the {len(start)} generators lies inside the shape"
            + (
                "; raise --grid"
                if params.labels is None
                else "; check that it has the coordinates of the input"
            )
        )
    surface = interface(places, inside)
    mesh = surface.mesh.with_vertices(frame.input_from_cube(surface.mesh.vertices))
    facts, expected = topology(mesh), source.topology()
    return Outcome(
        arrays={
            "generators": frame.input_from_cube(places),
            "generator_inside": inside,
            "history": history,
            **mesh.as_arrays("surface/"),
            "surface/face_generators": surface.generators,
        },
        files={"ply": ply.encode(mesh)},
        metrics={
            "method": params.method,
            "samples": len(samples),
            "generators": len(start),
            "inside_generators": int(inside.sum()),
            "topology": vars(facts),
            "input_topology": None
            if expected is None
            else {"euler_number": expected[0], "components": expected[1]},
            "final_loss": float(history[-1, 0]) if len(history) else None,
            "labels": params.labels or "input",
        },
        warnings=_warnings(facts.euler_number, facts.components, expected),
        recheck=watertight.as_written,
    )


def _warnings(euler: int, components: int, expected: tuple[int, int] | None) -> list[str]:
    if expected is None or expected == (euler, components):
        return []
    return [
        (
            f"the surface has Euler number {euler} and {components} components, but the input "
            f"has {expected[0]} and {expected[1]}: parts or holes were lost or joined; raise "
            "--grid"
        )
    ]


def _judge(context: Context) -> Source:
    """The source that decides what is inside. Raises InputError for a source without an inside."""
    from .inputs.resolve import identify

    named = context.params.labels
    if named is None:
        return context.source()
    found = identify(named)
    if found.kind not in ("mesh", "field"):
        raise InputError(f"{named}: is of kind {found.kind}, but --labels needs a mesh or a field")
    return found.open()


def _samples(context: Context, source: Source) -> tuple[Floats, CubeFrame]:
    """Samples of the surface in the method's cube, and the frame of that cube.

    They are in the order of the grid's boxes, so that samples that are processed together are close
    in memory.
    """
    import numpy as np

    from .baselines.sampling import DRAWN, even
    from .baselines.voromesh import CubeFrame, box_of

    params = context.params
    count = params.samples or SAMPLES * params.grid**2
    random = context.random("samples")
    measured = source.measured_points() is not None
    if measured:
        points = source.surface_samples(count, random)
    else:
        points = even(source.surface_samples(DRAWN * count, random), count, context.threads)
    box = source.bounding_box()
    if measured or not source.box_is_tight:
        # A field's box is the search region; the box of the surface made of points is not that of
        # the points.
        box = np.stack([points.min(axis=0), points.max(axis=0)])
    frame = CubeFrame.of_box(box)
    samples = frame.cube_from_input(points)
    return samples[np.argsort(box_of(samples, params.grid), kind="stable")], frame


def _memory(context: Context) -> float:
    params = context.params
    count = params.samples or SAMPLES * params.grid**2
    return peak(600.0, 400.0, 0.5, float(count))


STAGE = Stage(
    name="baseline",
    version=1,
    params=Params,
    run=run,
    parents=lambda params: ("classify",),
    reads_input=True,
    extra_inputs=lambda params: {} if params.labels is None else {"labels": params.labels},
    memory=_memory,
)
