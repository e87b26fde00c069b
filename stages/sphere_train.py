"""Stage sphere-train: spheres at the vertices, generator pairs at the faces, the final surface.

Example:
    >>> from vorolight.stages import pipeline, sphere_train
    >>> pipeline.execute(session, "sphere-train", sphere_train.Params())  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from . import contract
from .contract import Context, Outcome, Positive, Range, Stage
from .errors import UsageError

if TYPE_CHECKING:
    from .surface.model_frame import ModelFrame
    from .surface.polygons import Floats, PolygonMesh

NEIGHBOURS_EVERY = 10
"""Iterations between searches for spheres that may intrude."""
NEIGHBOUR_SLACK = 0.15
"""How much further than a sphere's radius is searched, for what moves in between."""
CORRESPONDENCES_EVERY = 10
"""Iterations between nearest-point searches of the shape loss."""
MERGE = 1e-4
"""In units of h0: edges of the diagram shorter than this are contracted where it is compared."""
SMALLEST_OFFSET = 0.05
"""In units of the spacing: pairs nearer to their face are moved out to this, never collapsed."""


DEFAULTS: dict[str, dict[str, float]] = {
    "triangle": {
        "iterations": 25,
        "weight_intersection": 30.0,
        "weight_exclusion": 30.0,
        "weight_shape": 100.0,
        "weight_normal": 0.0,
    },
    "polygon": {
        "iterations": 800,
        "learning_rate": 0.01,
        "weight_intersection": 60.0,
        "weight_exclusion": 10.0,
        "weight_shape": 1.0,
        "weight_normal": 0.1,
    },
    "paper": {
        "iterations": 800,
        "learning_rate": 0.01,
        "weight_intersection": 10.0,
        "weight_exclusion": 10.0,
        "weight_shape": 1.0,
        "weight_normal": 0.1,
    },
}
"""What an option that is not given is, by kind of faces or by preset."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the sphere-train stage."""

    faces: Literal["triangle", "polygon"] = "triangle"
    """Triangles, whose surface conforms exactly, or the polygons of the paper."""
    preset: Literal["default", "paper"] = "default"
    """paper: its losses, weights of 10, 10, 1 and 0.1; triangles are then polygons split at their
    centroids."""
    edge_length: Annotated[float, Range(0.05, 10)] = 0.6
    """Edge length of the triangles, in units of h0; shorter where the shape is thin."""
    iterations: Annotated[int, Range(0, 1_000_000)] | None = None
    """Gauss-Newton steps on triangles, 25 by default, or Adam iterations on polygons, 800."""
    learning_rate: Positive | None = None
    """First Adam step on polygons, 0.01 h0 by default; decays to 0 as a cosine."""
    weight_intersection: Positive | None = None
    """Weight of the sphere-intersection loss; for triangles, of pairs that are to exist."""
    weight_exclusion: Positive | None = None
    """Weight of the exclusion loss."""
    weight_shape: Positive | None = None
    """Weight of the shape loss."""
    weight_normal: Positive | None = None
    """Weight of normal consistency; for triangles, of vertices at the height of their
    neighbours."""
    weight_smooth: Positive = 0.02
    """Weight of vertices amid their neighbours, along the surface (triangles)."""
    weight_radius: Positive = 0.02
    """Weight of radii near the mean of their neighbours' (triangles)."""
    shape_loss: Literal["distance", "level-set", "chamfer"] | None = None
    """Distance to the surface (the default), or the paper's: level-set for fields, Chamfer for
    meshes (the default of the preset)."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points sampled on an input mesh for the Chamfer loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.conforming and self.shape_loss not in (None, "distance"):
            raise UsageError(
                f"--shape-loss {self.shape_loss}: triangles are trained on the distance; add "
                "--faces polygon or --preset paper"
            )
        if self.conforming and self.learning_rate is not None:
            raise UsageError(
                "--learning-rate: triangles are trained by Gauss-Newton steps, which have none; "
                "add --faces polygon or --preset paper"
            )

    @property
    def conforming(self) -> bool:
        """Whether triangles are trained whose pairs are in closed form."""
        return self.faces == "triangle" and self.preset == "default"

    def value(self, name: str) -> float:
        """What was given for ``name``, or its default."""
        given = getattr(self, name)
        kind = "paper" if self.preset == "paper" else self.faces
        return float(DEFAULTS[kind][name] if given is None else given)


def run(context: Context) -> Outcome:
    """Spheres and pairs of generators (the paper's sections 3.3 and 3.4), then the surface."""
    import torch

    torch.set_num_threads(context.threads)
    return _triangles(context) if context.params.conforming else _polygons(context)


def _triangles(context: Context) -> Outcome:
    """Triangle faces: remeshed, trained until they conform, and certified."""
    import numpy as np

    from .optimize.conforming import Leg, conform
    from .sources.true_surface import true_surface
    from .surface.geometry import fan_triangles
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .surface.remesh import remesh
    from .surface.sizing import for_surface
    from .surface.topology import topology

    params = context.params
    frame = ModelFrame.of(context.arrays("classify"))
    first = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    first = first.with_vertices(frame.model_from_input(first.vertices))
    surface = true_surface(context.source(), frame, context.threads)
    expected, given = context.source().topology(), topology(first)
    from_input = expected not in (None, (given.euler_number, given.components))
    if from_input:
        # The topology is known and the initial surface misses it; that of the input itself is kept
        # by everything that follows.
        first = context.source().manifold()
        first = first.with_vertices(frame.model_from_input(first.vertices))
    length = for_surface(surface.samples, surface.normals, params.edge_length)
    start = remesh(
        *fan_triangles(first)[:2],
        length,
        surface,
    )
    weights = {
        name: params.value(f"weight_{name}")
        for name in ("intersection", "exclusion", "shape", "normal")
    } | {"smooth": params.weight_smooth, "radius": params.weight_radius}
    spheres, history, rounds = conform(
        start,
        surface,
        Leg(int(params.value("iterations")), weights),
        context.checkpoints,
        context.progress,
        context.threads,
    )
    trained = PolygonMesh.of_triangles(spheres.centres, spheres.triangles)
    count = trained.face_count
    points, square = spheres.generators()
    outside, inside = points[:count], points[count:]
    warnings = []
    if from_input:
        warnings.append(
            "the initial surface has not the input's topology: the input's triangles were remeshed"
        )
    if context.device != "cpu":
        warnings.append(f"--device {context.device}: triangles are trained on the CPU")
    return _outcome(
        context, frame, trained, spheres.radii, np.sqrt(np.maximum(square, 0.0)), inside, outside,
        np.mean(spheres.lengths[spheres.triangles], axis=1) / params.edge_length, history,
        {"repair_rounds": rounds, "started_from": "input" if from_input else "init"}, warnings,
    )  # fmt: skip


def _polygons(context: Context) -> Outcome:
    """The paper's training on polygon faces, then the diagram of all pairs."""
    import numpy as np
    import torch

    from .losses import regularization, shape, sphere
    from .optimize.loop import Schedule, adam
    from .surface.frames import Connectivity, face_frames
    from .surface.geometry import face_frames as numpy_frames
    from .surface.geometry import fan_triangles
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .surface.spheres import initial_spheres, near_pairs
    from .voronoi.pairs import label_pairs

    params = context.params
    frame = ModelFrame.of(context.arrays("classify"))
    mesh = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    mesh = mesh.with_vertices(frame.model_from_input(mesh.vertices))
    if params.faces == "triangle":
        mesh = PolygonMesh.of_triangles(*fan_triangles(mesh)[:2])
    first_radii, first_offsets = initial_spheres(mesh)
    parameters = {
        name: torch.tensor(values, device=context.device).requires_grad_(True)
        for name, values in (
            ("centres", mesh.vertices), ("radii", first_radii), ("offsets", first_offsets)
        )
    }  # fmt: skip
    centres, radii, offsets = parameters.values()
    connectivity = Connectivity.of(mesh, context.device)
    usual = "distance" if params.preset == "default" else "paper"
    shape_loss = shape.for_source(context, frame, params.shape_loss or usual)
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
        {name: params.value(f"weight_{name}") for name in names},
        Schedule(int(params.value("iterations")), params.value("learning_rate"), "cosine", 50),
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
    warnings = []
    if pairs.undecided:
        warnings.append(
            f"{pairs.undecided} generator pairs lie on one side of the trained surface and were "
            "labelled by their face's orientation"
        )
    facts = {
        "relabelled": pairs.relabelled, "undecided": pairs.undecided, "collapsed": collapsed,
    }  # fmt: skip
    return _outcome(
        context, frame, trained, trained_radii, trained_offsets, pairs.inside, pairs.outside,
        np.ones(trained.face_count), history, {"pairs": facts}, warnings,
    )  # fmt: skip


def _outcome(
    context: Context,
    frame: ModelFrame,
    trained: PolygonMesh,
    radii: Floats,
    offsets: Floats,
    inside: Floats,
    outside: Floats,
    spacing: Floats,
    history: Floats,
    metrics: dict[str, Any],
    warnings: list[str],
) -> Outcome:
    """The certificate, the surface it allows to write, and the files in the input's coordinates."""
    import numpy as np

    from .export import ply
    from .metrics import watertight
    from .surface.topology import topology
    from .voronoi.certificate import certify
    from .voronoi.cleanup import clean
    from .voronoi.conformity import conformity
    from .voronoi.interface import interface

    count = trained.face_count
    generators = np.concatenate([inside, outside])
    labels, owner = np.arange(2 * count) < count, np.arange(2 * count) % count
    pairs = np.stack([np.arange(count), count + np.arange(count)], axis=1)
    certificate = certify(trained, radii, generators, labels, pairs, context.threads)
    raw = interface(generators, labels)
    agreement = conformity(raw, owner, trained, radii, inside, outside, 1.0, context.threads)
    merged = clean(raw, spacing=1.0, merge=MERGE)
    if certificate.holds:
        cleaned, written, bounds = merged, trained, np.stack([np.arange(count)] * 2, axis=1)
    else:
        cleaned = clean(raw, spacing=1.0)
        written, bounds = cleaned.mesh, owner[cleaned.generators]
        if agreement.pair_faces < count:
            warnings.append(
                f"{count - agreement.pair_faces} of {count} trained faces have no face in the "
                "diagram"
            )
        remedy = "; raise --iterations" if context.params.conforming else ""
        warnings.append(
            f"no certificate ({', '.join(certificate.failed)} fails): the interface of the "
            f"generators is written, {100 * agreement.pair_area_share:.2f} % of its area between "
            f"pairs{remedy}"
        )
    facts, expected = topology(written), context.source().topology()
    if expected is not None and expected != (facts.euler_number, facts.components):
        warnings.append(
            f"the surface has Euler number {facts.euler_number} and {facts.components} components, "
            f"the input {expected[0]} and {expected[1]}: raise -n"
        )
    surface = written.with_vertices(frame.input_from_model(written.vertices))
    placed = trained.with_vertices(frame.input_from_model(trained.vertices))
    names = ("intersection", "exclusion", "shape", "normal")
    return Outcome(
        arrays={
            "spheres/center": placed.vertices,
            "spheres/radius": frame.spacing * radii,
            **placed.as_arrays("trained/"),
            "trained/offset": frame.spacing * offsets,
            "generators/inside": frame.input_from_model(inside),
            "generators/outside": frame.input_from_model(outside),
            "spacing": frame.spacing * spacing,
            "history": history,
            **surface.as_arrays("surface/"),
            "surface/face_generators": bounds,
        },
        files={"ply": ply.encode(surface)},
        metrics={
            "trained_faces": count,
            "certificate": vars(certificate) | {"failed": list(certificate.failed)},
            "topology": vars(facts),
            "trained_topology": vars(topology(trained)),
            "conformity": vars(agreement),
            "faces_after_merging": merged.mesh.face_count,
            "cleanup": {
                "dropped_flat": cleaned.dropped_flat,
                "merged_vertices": cleaned.merged_vertices,
                "dropped_faces": cleaned.dropped_faces,
                "kept_degenerate": cleaned.kept_degenerate,
            },
            "final_losses": dict(zip(names, history[-1], strict=True)) if len(history) else {},
            **metrics,
        },
        warnings=warnings,
        recheck=watertight.as_written,
    )


STAGE = Stage(
    name="sphere-train",
    version=3,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "init"),
    reads_input=True,
)
