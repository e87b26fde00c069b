"""Stage sphere-train: train the final Voronoi surface and certify it.

Example:
    >>> from vorolight.stages import sphere_train
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "sphere-train", sphere_train.Params())  # doctest: +SKIP
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from . import torch_start
from .engine.stage import Context, Outcome, Stage
from .errors import NumericalFailure
from .memory import peak
from .sphere_train_params import DEFAULTS, Params

if TYPE_CHECKING:
    from collections.abc import Callable

    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import Floats
    from .voronoi.certificate import Certificate
    from .voronoi.trained_surface import TrainedSurface

SMALLEST_OFFSET = 0.05
"""Smallest distance of a pair from its face, in units of the spacing. Closer pairs are moved out to
it."""


def run(context: Context) -> Outcome:
    """Train spheres and pairs of generators (the paper's sections 3.3 and 3.4), and write the
    surface."""
    if context.params.by_adam or context.source().needs_torch:
        torch_start.start(context.threads)
    return _as_in_the_paper(context) if context.params.by_adam else _conforming(context)


def _on_cpu(context: Context) -> list[str]:
    device = context.device
    return (
        []
        if device == "cpu"
        else [f"--device {device} has no effect: this training runs on the CPU"]
    )


def _conforming(context: Context) -> Outcome:
    """Remesh triangles and train them until they conform, then merge polygons of them."""
    import numpy as np

    from .mesh.model_frame import ModelFrame
    from .training.agreement import Polygons
    from .training.polygons import train_polygons
    from .training.refinement import Refine
    from .training.triangles import resisting as where
    from .training.triangles import train_triangles
    from .voronoi.trained_surface import TrainedSurface

    params = context.params
    frame = ModelFrame.of(context.arrays("classify"))
    names = ("intersection", "exclusion", "shape", "normal", "smooth", "radius")
    weights = params.weights(*names)
    done = train_triangles(
        context,
        params.spacing,
        weights,
        int(params.value("iterations")),
        params.angle,
        None if params.refine is None else Refine(params.refine, params.faces_target),
    )
    spheres, history, facts = done.spheres, done.history, done.facts()
    warnings = done.warnings() + _on_cpu(context)
    polygons = Polygons.of_triangles(spheres)
    if params.faces == "polygon":
        if spheres.intruded(context.threads).any():
            warnings.append(
                "no triangles were merged into polygons, since the triangles have no "
                "certificate: raise -n, or lower --edge-length"
            )
        else:
            polygons, losses, rounds = train_polygons(
                spheres,
                context.surface,
                done.creases,
                weights,
                params.polygon_share,
                context.checkpoints,
                done.stored(),
                context.progress,
                context.threads,
            )
            history = np.concatenate([history, losses])
            facts["polygons"] = polygons.facts() | {"rounds": rounds}
            if params.polygon_share > 0 and not polygons.large.any():
                warnings.append(
                    f"all faces are triangles, since no polygon conforms after {rounds} "
                    "rounds: raise -n, or lower --edge-length"
                )
    trained, corners = polygons.placed(), polygons.spheres

    def resisting() -> str:
        return where(spheres, frame, context.threads)

    points, square = corners.generators()
    count = trained.face_count
    surface = TrainedSurface(
        polygons=trained,
        radii=corners.radii,
        inside=points[count:],
        outside=points[:count],
        offsets=np.sqrt(np.maximum(square, 0.0)),
        spacing=corners.face_lengths / params.value("edge_length"),
    )
    return _outcome(context, frame, surface, history, facts, warnings, resisting)


def _as_in_the_paper(context: Context) -> Outcome:
    """Train the initial surface as the paper does, and compute the diagram of all pairs."""
    import numpy as np

    from .mesh.geometry import face_frames, fan_triangles
    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import PolygonMesh
    from .solvers.adam import Schedule
    from .training.losses import shape
    from .training.paper import train
    from .voronoi.pairs import label_pairs
    from .voronoi.trained_surface import TrainedSurface

    params = context.params
    frame = ModelFrame.of(context.arrays("classify"))
    mesh = PolygonMesh.from_arrays(context.arrays("init"), "surface/")
    mesh = mesh.with_vertices(frame.model_from_input(mesh.vertices))
    if params.faces == "triangle":
        mesh = PolygonMesh.of_triangles(*fan_triangles(mesh)[:2])
    centres, radii, offsets, history = train(
        mesh,
        shape.for_source(context, frame, params.shape_loss or "paper"),
        params.weights("intersection", "exclusion", "shape", "normal"),
        Schedule(int(params.value("iterations")), params.value("learning_rate"), "cosine", 50),
        context.checkpoints,
        context.progress,
        context.device,
        context.threads,
    )
    trained = mesh.with_vertices(centres)
    _, normal, centroid = face_frames(trained)
    reach = np.maximum(np.abs(offsets), SMALLEST_OFFSET)[:, None] * normal
    pairs = label_pairs(trained, centroid + reach, centroid - reach)
    warnings = []
    if pairs.undecided:
        warnings.append(
            f"{pairs.undecided} generator pairs lie on one side of the trained surface and "
            "were labelled by the orientation of their face: the written surface may differ "
            "there"
        )
    facts = {
        "collapsed": int((np.abs(offsets) < SMALLEST_OFFSET).sum()),
        "pairs": {key: getattr(pairs, key) for key in ("relabelled", "replaced", "undecided")},
    }
    surface = TrainedSurface(
        trained, radii, pairs.inside, pairs.outside, offsets, np.ones(trained.face_count)
    )
    return _outcome(context, frame, surface, history, facts, warnings)


def _outcome(
    context: Context,
    frame: ModelFrame,
    trained: TrainedSurface,
    history: Floats,
    metrics: dict[str, Any],
    warnings: list[str],
    resisting: Callable[[], str] | None = None,
) -> Outcome:
    """Certify the surface, and make its files in the coordinates of the input.

    Raises NumericalFailure if a certificate is required and missing; ``resisting`` gives the reason
    and the places.
    """
    from functools import partial

    from .formats import ply
    from .mesh.topology import topology
    from .metrics import watertight
    from .metrics.departures import departures
    from .solvers.gauss_newton import TERMS
    from .voronoi.output_surface import written

    params, count = context.params, trained.face_count
    merge = params.merge if params.by_adam and params.faces == "polygon" else 0.0

    def refused(certificate: Certificate) -> None:
        if resisting is not None and not params.allow_uncertified:
            raise NumericalFailure(
                f"no certificate ({', '.join(certificate.failed)} fails): {resisting()}; "
                "raise -n, lower --edge-length, or try --sharp off; --allow-uncertified "
                "writes the interface of the diagram instead"
            )

    found = written(trained, merge, context.threads, refused)
    warnings = warnings + found.warnings(count, merge)
    apart = departures(found.mesh, context.source(), context.surface, frame, context.threads)
    warnings += apart.warnings(frame.spacing)
    facts, expected = topology(found.mesh), context.source().topology()
    trained_facts = topology(trained.polygons)
    if expected is not None and expected != (facts.euler_number, facts.components):
        warnings.append(
            f"the surface has Euler number {facts.euler_number} and {facts.components} "
            f"components, but the input has {expected[0]} and {expected[1]}: parts or holes "
            "were lost or joined; raise -n"
        )
    surface = found.mesh.with_vertices(frame.input_from_model(found.mesh.vertices))
    names = (*TERMS[:3], "normal") if params.by_adam else TERMS
    return Outcome(
        arrays={
            **trained.as_arrays(frame),
            "history": history,
            **surface.as_arrays("surface/"),
            "surface/face_generators": found.bounds,
        },
        files={"ply": ply.encode(surface)},
        metrics={
            "trained_faces": count,
            "topology": vars(facts),
            "topology_of_input": None
            if expected is None
            else {"euler_number": expected[0], "components": expected[1]},
            "trained_topology": vars(trained_facts),
            "departures": apart.facts(),
            **found.facts(),
            "final_losses": dict(zip(names, history[-1], strict=True)) if len(history) else {},
            **metrics,
        },
        warnings=warnings,
        recheck=partial(
            watertight.as_written,
            certified=trained_facts if found.certificate.holds else None,
        ),
    )


def _memory(context: Context) -> float:
    from .inputs.effort import MEMORY

    params = context.params
    least, start, each = MEMORY
    if params.by_adam:
        return peak(least, start, 30.0, len(context.arrays("init")["surface/face_offsets"]) - 1.0)
    classified = context.folder.manifest("classify")
    assert classified is not None
    triangles = float(classified["metrics"]["effort"]["triangles"])
    finer = (DEFAULTS["triangle"]["edge_length"] / params.value("edge_length")) ** 2
    return peak(least, start, each, params.faces_target or triangles * finer)


STAGE = Stage(
    name="sphere-train",
    version=17,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "init"),
    reads_input=True,
    memory=_memory,
)
