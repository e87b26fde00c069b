"""Stage init: generators around the boundary, and the first Voronoi surface.

Example:
    >>> from vorolight.stages import init, pipeline
    >>> pipeline.execute(session, "init", init.Params(iterations=60))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from . import contract
from .contract import Context, Outcome, Positive, Range, Stage

JITTER = 1e-3
"""Standard deviation of what is added to the first generators, in voxels."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the init stage."""

    iterations: Annotated[int, Range(0, 100_000)] = 60
    """Adam iterations on the generators; the diagram is computed anew in each."""
    learning_rate: Positive = 0.02
    """Adam step, in units of the voxel edge h0."""
    weight_shape: Positive = 1.0
    """Weight of the shape loss."""
    weight_normal: Positive = 0.1
    """Weight of normal consistency."""
    weight_area: Positive = 0.1
    """Weight of area uniformity."""
    weight_centroid: Positive = 0.1
    """Weight of centroid alignment."""
    field_loss: Literal["distance", "level-set"] = "distance"
    """For fields: the distance to first order, or the paper's level-set loss."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points sampled on an input mesh for the Chamfer loss."""


def run(context: Context) -> Outcome:
    """Boundary reflection, then Adam on all generators (paper's section 3.2, appendix C.1)."""
    import numpy as np
    import torch

    from .export import ply
    from .losses import regularization, shape
    from .metrics import watertight
    from .optimize.loop import Schedule, adam
    from .sources.voxels import VoxelGrid
    from .surface.frames import Connectivity, face_frames
    from .surface.model_frame import ModelFrame
    from .surface.topology import topology
    from .voronoi.cleanup import clean
    from .voronoi.delaunay import delaunay
    from .voronoi.interface import interface, without_islands
    from .voronoi.reflection import reflect
    from .voronoi.rings import ring_mesh, select_interface, voronoi_rings
    from .voronoi.vertices import voronoi_vertices

    torch.set_num_threads(context.threads)
    params = context.params
    stored = context.arrays("classify")
    grid = VoxelGrid(
        stored["origin"], float(stored["spacing"]), stored["interior"], stored["exterior"]
    )
    frame = ModelFrame.of(stored)
    start, inside = reflect(grid)
    # Mirrored in a flat face the lattice of voxel centres goes on as a lattice, whose tetrahedra
    # have no circumcentre to differentiate; a thousandth of a voxel off it they do.
    jitter = context.random("jitter").standard_normal(start.shape)
    start = start + JITTER * grid.spacing * jitter
    generators = torch.tensor(frame.model_from_input(start), device=context.device)
    generators.requires_grad_(True)
    shape_loss = shape.for_source(context, frame)

    def losses(iteration: int) -> dict[str, torch.Tensor]:
        here = generators.detach().cpu().numpy()
        diagram = delaunay(here)
        mesh, used = ring_mesh(voronoi_rings(here, diagram, select_interface(inside)))
        corners = torch.as_tensor(diagram.corners[used], device=context.device)
        vertices = voronoi_vertices(generators, corners)
        connectivity = Connectivity.of(mesh, context.device)
        frames = face_frames(vertices, connectivity)
        return {
            "shape": shape_loss(shape.surface_samples(vertices, frames), True),
            "normal": regularization.normal_consistency(frames, connectivity),
            "area": regularization.area_uniformity(frames),
            "centroid": regularization.centroid_alignment(frames, connectivity),
        }

    history = adam(
        {"generators": generators},
        losses,
        {key: getattr(params, f"weight_{key}") for key in ("shape", "normal", "area", "centroid")},
        Schedule(params.iterations, params.learning_rate, "constant", checkpoint_every=20),
        context.checkpoints,
        context.progress,
        "init",
    )
    trained = generators.detach().cpu().numpy()
    trained, inside, islands = without_islands(trained, inside, smallest=1.0)
    surface = clean(interface(trained, inside), spacing=1.0)
    mesh = surface.mesh.with_vertices(frame.input_from_model(surface.mesh.vertices))
    facts = topology(mesh)
    warnings = []
    if islands:
        warnings.append(f"{islands} specks smaller than a voxel were removed from the surface")
    return Outcome(
        arrays={
            "generators": frame.input_from_model(trained),
            "generator_inside": inside,
            "spacing": np.full(len(trained), grid.spacing),
            "history": history,
            **mesh.as_arrays("surface/"),
            "surface/face_generators": surface.generators,
        },
        files={"ply": ply.encode(mesh)},
        metrics={
            "generators": len(trained),
            "inside_generators": int(inside.sum()),
            "topology": vars(facts),
            "specks_removed": islands,
            "final_losses": dict(
                zip(("shape", "normal", "area", "centroid"), history[-1], strict=True)
            )
            if len(history)
            else {},
        },
        warnings=warnings,
        recheck=watertight.as_written,
    )


STAGE = Stage(
    name="init",
    version=1,
    params=Params,
    run=run,
    parents=lambda params: ("classify",),
    reads_input=True,
)
