"""Stage sphere-train: spheres at the vertices, generator pairs at the faces, the final surface.

Example:
    >>> from vorolight.stages import pipeline, sphere_train
    >>> pipeline.execute(session, "sphere-train", sphere_train.Params())  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from . import contract
from .contract import Context, Outcome, Positive, Range, Stage

NEIGHBOURS_EVERY = 10
"""Iterations between searches for spheres that may intrude."""
NEIGHBOUR_SLACK = 0.15
"""How much further than a sphere's radius is searched, for what moves in between."""
CORRESPONDENCES_EVERY = 5
"""Iterations between nearest-point searches of the Chamfer loss."""
SMALLEST_OFFSET = 0.05
"""In units of the spacing: pairs nearer to their face are moved out to this, never collapsed."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the sphere-train stage."""

    iterations: Annotated[int, Range(0, 1_000_000)] = 800
    """Adam iterations on centres, radii and offsets."""
    learning_rate: Positive = 0.01
    """First Adam step, in units of the voxel edge h0; decays to 0 as a cosine."""
    weight_intersection: Positive = 10.0
    """Weight of the sphere-intersection loss."""
    weight_exclusion: Positive = 10.0
    """Weight of the exclusion loss."""
    weight_shape: Positive = 1.0
    """Weight of the shape loss."""
    weight_normal: Positive = 0.1
    """Weight of normal consistency."""
    field_loss: Literal["distance", "level-set"] = "distance"
    """For fields: the distance to first order, or the paper's level-set loss."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points sampled on an input mesh for the Chamfer loss."""


def run(context: Context) -> Outcome:
    """The paper's sections 3.3 and 3.4 on polygon faces, then the diagram of all pairs."""
    import numpy as np
    import torch

    from .export import ply
    from .losses import regularization, shape, sphere
    from .metrics import watertight
    from .optimize.loop import Schedule, adam
    from .surface.frames import Connectivity, face_frames
    from .surface.geometry import face_frames as numpy_frames
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .surface.spheres import initial_spheres, near_pairs
    from .surface.topology import topology
    from .voronoi.cleanup import clean
    from .voronoi.conformity import conformity
    from .voronoi.interface import interface
    from .voronoi.pairs import label_pairs

    torch.set_num_threads(context.threads)
    params = context.params
    frame = ModelFrame.of(context.arrays("classify"))
    mesh = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    mesh = mesh.with_vertices(frame.model_from_input(mesh.vertices))
    first_radii, first_offsets = initial_spheres(mesh)
    parameters = {
        name: torch.tensor(values, device=context.device).requires_grad_(True)
        for name, values in (
            ("centres", mesh.vertices), ("radii", first_radii), ("offsets", first_offsets)
        )
    }  # fmt: skip
    centres, radii, offsets = parameters.values()
    connectivity = Connectivity.of(mesh, context.device)
    shape_loss = shape.for_source(context, frame)
    near: list[torch.Tensor] = []

    def losses(iteration: int) -> dict[str, torch.Tensor]:
        frames = face_frames(centres, connectivity)
        outer, inner = sphere.targets(frames.centroid, frames.normal, offsets)
        points = torch.cat([outer, inner])
        if iteration % NEIGHBOURS_EVERY == 0 or not near:
            found = near_pairs(
                mesh,
                points.detach().cpu().numpy(),
                centres.detach().cpu().numpy(),
                radii.detach().cpu().numpy(),
                NEIGHBOUR_SLACK,
                context.threads,
            )
            near[:] = [torch.as_tensor(index, device=context.device) for index in found]
        return {
            "intersection": sphere.intersection(
                outer, inner, centres, radii, connectivity.corner_faces, connectivity.corners
            ),
            "exclusion": sphere.exclusion(points, centres, radii, near[0], near[1]),
            "shape": shape_loss(
                shape.surface_samples(centres, frames), iteration % CORRESPONDENCES_EVERY == 0
            ),
            "normal": regularization.normal_consistency(frames, connectivity),
        }

    names = ("intersection", "exclusion", "shape", "normal")
    history = adam(
        parameters,
        losses,
        {name: getattr(params, f"weight_{name}") for name in names},
        Schedule(params.iterations, params.learning_rate, "cosine", checkpoint_every=50),
        context.checkpoints,
        context.progress,
        "sphere-train",
    )
    trained_centres, trained_radii, trained_offsets = (
        tensor.detach().cpu().numpy() for tensor in parameters.values()
    )
    trained = mesh.with_vertices(trained_centres)
    _, normal, centroid = numpy_frames(trained)
    collapsed = int((np.abs(trained_offsets) < SMALLEST_OFFSET).sum())
    reach = np.maximum(np.abs(trained_offsets), SMALLEST_OFFSET)[:, None] * normal
    pairs = label_pairs(trained, centroid + reach, centroid - reach)
    generators = np.concatenate([pairs.inside, pairs.outside])
    count = trained.face_count
    raw = interface(generators, np.arange(2 * count) < count)
    owner = np.arange(2 * count) % count
    agreement = conformity(
        raw, owner, trained, trained_radii, pairs.inside, pairs.outside, 1.0, context.threads
    )
    final = clean(raw, spacing=1.0)
    surface = final.mesh.with_vertices(frame.input_from_model(final.mesh.vertices))
    facts = topology(surface)
    warnings = []
    if pairs.undecided:
        warnings.append(
            f"{pairs.undecided} generator pairs lie on one side of the trained surface and were "
            "labelled by their face's orientation"
        )
    if agreement.pair_faces < count:
        warnings.append(
            f"{count - agreement.pair_faces} of {count} trained faces have no face in the diagram"
        )
    warnings.append(
        "the trained polygons are not exactly the interface of their generators: the interface is "
        f"written, {100 * agreement.pair_area_share:.1f} % of its area between pairs"
    )
    return Outcome(
        arrays={
            "spheres/center": frame.input_from_model(trained_centres),
            "spheres/radius": frame.spacing * trained_radii,
            **trained.with_vertices(frame.input_from_model(trained_centres)).as_arrays("trained/"),
            "trained/offset": frame.spacing * trained_offsets,
            "generators/inside": frame.input_from_model(pairs.inside),
            "generators/outside": frame.input_from_model(pairs.outside),
            "spacing": np.full(count, frame.spacing),
            "history": history,
            **surface.as_arrays("surface/"),
            "surface/face_generators": owner[final.generators],
        },
        files={"ply": ply.encode(surface)},
        metrics={
            "trained_faces": count,
            "topology": vars(facts),
            "trained_topology": vars(topology(trained)),
            "conformity": vars(agreement),
            "pairs": {
                "relabelled": pairs.relabelled,
                "undecided": pairs.undecided,
                "collapsed": collapsed,
            },
            "cleanup": {
                "dropped_flat": final.dropped_flat,
                "merged_vertices": final.merged_vertices,
                "dropped_faces": final.dropped_faces,
                "kept_degenerate": final.kept_degenerate,
            },
            "final_losses": dict(zip(names, history[-1], strict=True)) if len(history) else {},
        },
        warnings=warnings,
        recheck=watertight.as_written,
    )


STAGE = Stage(
    name="sphere-train",
    version=1,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "init"),
    reads_input=True,
)
