"""Stage init: fit the first Voronoi surface to the shape.

Example:
    >>> from vorolight.stages import init
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "init", init.Params(iterations=60))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from . import torch_start
from .engine.params import Positive, Range, StageParams
from .engine.stage import Context, Outcome, Stage
from .errors import InputError
from .memory import peak

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import Floats
    from .mesh.topology import Topology
    from .mesh.voxels import VoxelGrid
    from .training.losses.images import ImageLoss
    from .training.losses.shape import ShapeLoss
    from .voronoi.diagram.cleanup import CleanSurface

JITTER = 1e-3
"""Standard deviation of the noise that is added to the paper's first generators, in voxels."""
LEVELS, MOST = 3, 60_000
"""How often voxels are divided where the shape is thin, until the surface has the input's topology.
It ends when there are more generators than MOST and more than twice as many as at first."""
PATIENCE = 10
"""Iterations without gain after which the loop ends."""
WORSE, NEAR = 2.0, 1e-3
"""A warning is given if the iterations raise the shape loss by more than the factor WORSE, unless
it stays below NEAR."""
SPECK = 0.1
"""Components that enclose less than this many voxels are removed."""


DEFAULTS: dict[str, dict[str, float]] = {
    "surface": {
        "learning_rate": 0.01,
        "weight_shape": 100.0,
        "weight_normal": 5.0,
        "weight_area": 0.01,
    },
    "voxels": {
        "learning_rate": 0.02,
        "weight_shape": 1.0,
        "weight_normal": 0.1,
        "weight_area": 0.1,
    },
}
"""Defaults of options by the kind of start. Mirrored generators are close to the shape already; the
paper's weights would give that up for even faces."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the init stage."""

    start: Literal["surface", "voxels"] = "surface"
    """Where the first generators are mirrored: in the true surface, or in the boundary of the
    voxels as in the paper."""
    iterations: Annotated[int, Range(0, 100_000)] = 20
    """Maximum number of Adam iterations on the generators. They end early after ten iterations
    without gain."""
    learning_rate: Positive | None = None
    """Step of Adam, in units of the voxel edge h0. Default: 0.01, or 0.02 with --start voxels."""
    weight_shape: Positive | None = None
    """Weight of the shape loss. Default: 100, or 1 with --start voxels."""
    weight_normal: Positive | None = None
    """Weight of normal consistency. Default: 5, or 0.1 with --start voxels."""
    weight_area: Positive | None = None
    """Weight of area uniformity. Default: 0.01, or 0.1 with --start voxels."""
    weight_centroid: Positive = 0.1
    """Weight of centroid alignment."""
    shape_loss: Literal["distance", "level-set", "chamfer", "images"] = "distance"
    """The shape loss: distance to the surface, or a loss of the paper: level-set for fields,
    chamfer for meshes and points, images for views."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Number of points sampled on a mesh for the Chamfer loss."""

    def value(self, name: str) -> float:
        """The given value of ``name``, or its default."""
        given = getattr(self, name)
        return float(DEFAULTS[self.start][name] if given is None else given)


def run(context: Context) -> Outcome:
    """Boundary reflection, then Adam on all generators (paper's section 3.2, appendix C.1)."""
    import numpy as np
    import torch

    from .formats import ply
    from .mesh.model_frame import ModelFrame
    from .mesh.topology import topology
    from .mesh.voxels import VoxelGrid
    from .metrics import watertight
    from .solvers.adam import Schedule, adam
    from .training.losses import shape
    from .voronoi.diagram.cleanup import clean
    from .voronoi.diagram.interface import interface, without_islands

    torch_start.start(context.threads)
    params = context.params
    stored = context.arrays("classify")
    grid = VoxelGrid(
        stored["origin"], float(stored["spacing"]), stored["interior"], stored["exterior"]
    )
    frame = ModelFrame.of(stored)
    start, inside, levels, expected = _first_generators(context, grid, frame)
    generators = torch.tensor(start, device=context.device)
    generators.requires_grad_(True)
    shape_loss = shape.for_source(context, frame, params.shape_loss)

    def losses(iteration: int) -> dict[str, torch.Tensor]:
        return surface_losses(generators, inside, shape_loss, iteration)

    history = adam(
        {"generators": generators},
        losses,
        {key: params.value(f"weight_{key}") for key in ("shape", "normal", "area")}
        | {"centroid": params.weight_centroid},
        Schedule(
            params.iterations, params.value("learning_rate"), "constant", 20, patience=PATIENCE
        ),
        context.checkpoints,
        context.progress,
        "init",
    )

    def as_surface(places: Floats) -> tuple[Floats, NDArray[np.bool_], int, CleanSurface, Topology]:
        kept, labels, gone = without_islands(places, inside, smallest=SPECK)
        cleaned = clean(interface(kept, labels), spacing=1.0)
        return kept, labels, gone, cleaned, topology(cleaned.mesh)

    def as_expected(found: Topology) -> bool:
        return expected is None or expected == (found.euler_number, found.components)

    warnings = []
    trained, labels, islands, surface, facts = as_surface(generators.detach().cpu().numpy())
    if params.iterations and not as_expected(facts):
        first = as_surface(start)
        if as_expected(first[-1]):
            trained, labels, islands, surface, facts = first
            warnings.append(
                "the iterations changed the topology of the first surface, so they were undone"
            )
    mesh = surface.mesh.with_vertices(frame.input_from_model(surface.mesh.vertices))
    if len(history) and history[-1, 0] > max(WORSE * history[0, 0], NEAR):
        warnings.append(
            f"the iterations moved the surface away from the shape (loss {history[0, 0]:.3g}, then "
            f"{history[-1, 0]:.3g}): raise --weight-shape or lower --learning-rate"
        )
    if islands:
        warnings.append(
            f"{islands} components smaller than {SPECK:g} voxels were removed from the first "
            "surface"
        )
    if expected is not None and not as_expected(facts):
        warnings.append(
            f"the first surface has Euler number {facts.euler_number} and {facts.components} "
            f"components, but the input has {expected[0]} and {expected[1]}: sphere-train "
            "starts from the input's triangles instead; with --preset paper, raise -n"
        )
    return Outcome(
        arrays={
            "generators": frame.input_from_model(trained),
            "generator_inside": labels,
            "spacing": np.full(len(trained), grid.spacing),
            "history": history,
            **mesh.as_arrays("surface/"),
            "surface/face_generators": surface.generators,
        },
        files={"ply": ply.encode(mesh)},
        metrics={
            "generators": len(trained),
            "inside_generators": int(labels.sum()),
            "topology": vars(facts),
            "specks_removed": islands,
            "levels": levels,
            "input_topology": None
            if expected is None
            else {"euler_number": expected[0], "components": expected[1]},
            "final_losses": dict(
                zip(("shape", "normal", "area", "centroid"), history[-1], strict=True)
            )
            if len(history)
            else {},
        },
        warnings=warnings,
        recheck=watertight.as_written,
    )


def surface_losses(
    generators: torch.Tensor,
    inside: NDArray[np.bool_],
    shape_loss: ShapeLoss | ImageLoss,
    iteration: int = 0,
) -> dict[str, torch.Tensor]:
    """The losses of the interface of ``generators (N, 3)``, for which a new diagram is computed."""
    import torch

    from .mesh.frames import Connectivity, face_frames
    from .training.losses import regularization, shape
    from .voronoi.diagram.delaunay import in_passing
    from .voronoi.diagram.rings import ring_mesh, select_interface, voronoi_rings
    from .voronoi.diagram.vertices import voronoi_vertices

    here = generators.detach().cpu().numpy()
    diagram = in_passing(here)
    mesh, used = ring_mesh(voronoi_rings(here, diagram, select_interface(inside)))
    corners = torch.as_tensor(diagram.corners[used], device=generators.device)
    vertices = voronoi_vertices(generators, corners)
    connectivity = Connectivity.of(mesh, str(generators.device))
    frames = face_frames(vertices, connectivity)
    return {
        "shape": shape.evaluate(shape_loss, vertices, frames, mesh, iteration, True),
        "normal": regularization.normal_consistency(frames, connectivity),
        "area": regularization.area_uniformity(frames),
        "centroid": regularization.centroid_alignment(frames, connectivity),
    }


def _first_generators(
    context: Context, grid: VoxelGrid, frame: ModelFrame
) -> tuple[Floats, NDArray[np.bool_], int, tuple[int, int] | None]:
    """Generators in model units, their labels, how often voxels were divided, and the input's Euler
    number and components if they are known."""
    import numpy as np

    from .mesh.topology import topology
    from .voronoi.diagram.cleanup import clean
    from .voronoi.diagram.interface import interface, without_islands
    from .voronoi.start.mirror import FAR, mirrored
    from .voronoi.start.reflection import reflect

    source = context.source()
    expected = source.topology()
    if context.params.start == "voxels":
        start, inside = reflect(grid)
        # Voxel centres mirrored in a flat face form a lattice again. Its tetrahedra have no unique
        # circumcentre to differentiate; a shift of a thousandth of a voxel prevents this.
        start = start + JITTER * grid.spacing * context.random("jitter").standard_normal(
            start.shape
        )
        return frame.model_from_input(start), inside, 0, expected
    best: tuple[int, Floats, NDArray[np.bool_], int] | None = None
    for levels in range(LEVELS + 1):
        start, inside = mirrored(
            context.surface, grid.interior, levels, context.random("jitter", levels)
        )
        if best is not None and len(start) > max(MOST, 2 * len(best[1])):
            break
        start, inside, _ = without_islands(start, inside, smallest=SPECK)
        raw = interface(start, inside)
        if raw.mesh.face_count == 0:
            continue
        kept = np.zeros(len(start), dtype=bool)
        kept[raw.generators] = True
        kept[-FAR:] = True  # These stay fixed and bound the diagram while the others move.
        facts = topology(clean(raw, spacing=1.0).mesh)
        wrong = 0
        if expected is not None:
            wrong = abs(facts.euler_number - expected[0]) + abs(facts.components - expected[1])
        if best is None or wrong < best[0]:
            best = wrong, start[kept], inside[kept], levels
        if wrong == 0:
            break
    if best is None:
        raise InputError(
            f"{source.path or source.name}: the shape is thinner than the voxels "
            f"({grid.spacing:.4g}) everywhere, so no generator lies inside; raise -n"
        )
    return *best[1:], expected


def _memory(context: Context) -> float:
    # There are about as many generators as voxels in the exterior band.
    return peak(600.0, 400.0, 12.0, float(context.arrays("classify")["exterior"].sum()))


STAGE = Stage(
    name="init",
    version=7,
    params=Params,
    run=run,
    parents=lambda params: ("classify",),
    reads_input=True,
    memory=_memory,
)
