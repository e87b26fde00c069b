"""Stage evaluate: measure a surface against the input or a reference.

Example:
    >>> from vorolight.stages import evaluate
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "evaluate", evaluate.Params(of="init"))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from .engine.params import Range, StageParams
from .engine.stage import Context, Outcome, Stage
from .errors import InputError
from .formats import packed
from .memory import peak

if TYPE_CHECKING:
    from .inputs.source import Source
    from .mesh.polygons import Floats, Ints, PolygonMesh

OTHER_UNITS, OTHER_SIZE = 5.0, 1.25
"""Largest ratio of the sizes of a surface and its reference. Above OTHER_UNITS the comparison is
refused, above OTHER_SIZE there is a warning."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the evaluate stage."""

    of: Literal["init", "sphere-train", "volume", "baseline"] = "sphere-train"
    """The stage whose surface is measured."""
    surface: str | None = None
    """A mesh file to measure in place of a stage's surface, in the input's coordinates."""
    reference: str | None = None
    """A mesh file or built-in field to compare with. Default: the input of the run."""
    protocol: Literal["vorolight", "voromesh"] = "vorolight"
    """Number of samples and threshold of F1: vorolight for 50,000 and 0.01, voromesh for 100,000
    and 0.003."""
    samples: Annotated[int, Range(1000, 10_000_000)] | None = None
    """Number of points on each surface. Default: that of the protocol."""
    threshold: Annotated[float, Range(1e-6, 1)] | None = None
    """Distance for F1, where the diagonal of the reference's bounding box is 1. Default: that of
    the protocol."""


def run(context: Context) -> Outcome:
    """The paper's appendix B, and in addition figures that do not depend on samples."""
    import numpy as np

    from .artifacts.manifest import foreign
    from .formats import ply
    from .inputs.resolve import identify
    from .mesh import geometry
    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import PolygonMesh
    from .mesh.topology import topology
    from .metrics import chamfer, creases, curvature, gates
    from .metrics.fidelity import fidelity
    from .metrics.protocols import PROTOCOLS

    params, threads = context.params, context.threads
    of = f"file {Path(params.surface).name}" if params.surface else params.of
    mesh = _surface(context)
    source = context.source() if params.reference is None else identify(params.reference).open()
    protocol = PROTOCOLS[params.protocol].changed(params.samples, params.threshold)
    samples, random = protocol["samples"], context.random
    context.progress.start("evaluate", 5)
    vertices, triangles, _ = geometry.fan_triangles(mesh)
    predicted, _ = geometry.sample_triangles(vertices, triangles, samples, random("predicted"))
    reference = source.surface_samples(samples, random("reference"))
    given, triangulated = source.given_polygons(), source.triangulated()
    low, high = source.bounding_box()
    if not source.box_is_tight:
        low, high = reference.min(axis=0), reference.max(axis=0)
    area = float(geometry.triangle_areas(vertices, triangles).sum())
    true_area = (
        area  # that of a field is not known
        if triangulated is None
        else float(geometry.triangle_areas(*triangulated).sum())
    )
    name = params.reference or source.name
    warnings = _comparable(name, source, mesh.vertices[mesh.face_vertices], np.stack([low, high]))
    diagonal, longest = float(np.linalg.norm(high - low)), float(np.max(high - low))
    whole = given and PolygonMesh.of_triangles(*geometry.fan_triangles(given)[:2])
    distances = chamfer.chamfer(
        predicted / diagonal,
        reference / diagonal,
        protocol["threshold"],
        true_area / diagonal**2,
        threads,
    )
    frame = ModelFrame.of(context.arrays("classify"))
    truth = source.true_surface(frame, threads)
    placed = frame.model_from_input(reference)
    close = fidelity(
        frame.model_from_input(vertices),
        triangles,
        truth,
        (placed, truth.closest(placed)[1]),
        samples,
        random("fidelity"),
        threads,
    ).scaled(frame.spacing / diagonal)
    context.progress.advance(1)
    edge = source.median_edge_length() or frame.spacing / 2
    radius = curvature.REACH * edge
    measured, valid = curvature.mean_curvature(vertices, triangles, radius, threads)
    bent = curvature.statistics(vertices, triangles, radius, measured, valid)
    ridges = creases.of_reference(source, frame)
    off = None if ridges is None else ridges.distance
    smooth = curvature.off_creases(vertices, triangles, radius, measured, valid, off)
    context.progress.advance(2)
    even, even_smooth = curvature.resampled(vertices, triangles, edge, off, threads)
    if even is None:
        warnings.append(
            "|H| of the evenly resampled surface was not measured: edges as short as those "
            f"of the reference ({edge:.3g}) would give more than {curvature.MOST_VERTICES:,} "
            "vertices"
        )
    context.progress.advance(3)
    facts, defects = topology(mesh), gates.defects(mesh)
    expected = source.topology()
    metrics: dict[str, Any] = {
        "of": of,
        "protocol": protocol | {"diagonal": diagonal, "reference": source.name},
        "curvature_settings": curvature.settings(edge, given is not None),
        "topology": vars(facts),
        "expected_topology": expected
        and dict(zip(("euler_number", "components"), expected, strict=True)),
        "area": area,
        "volume": geometry.enclosed_volume(vertices, triangles),
        "chamfer": vars(distances),
        "fidelity": vars(close),
        "curvature": None if bent is None else vars(bent),
        "resampled_curvature": None if even is None else vars(even),
        "dihedral_mean_curvature": curvature.dihedral_mean_curvature(mesh),
        "reference_dihedral": None if whole is None else curvature.dihedral_mean_curvature(whole),
        "curvature_off_creases": None if smooth is None else vars(smooth),
        "resampled_curvature_off_creases": None if even_smooth is None else vars(even_smooth),
        **curvature.of_reference(source, reference, radius, off, threads),
        "creases": None
        if ridges is None
        else vars(creases.agreement(ridges, mesh, longest, frame.spacing)),
        "reference_creases": None
        if ridges is None or whole is None
        else vars(creases.agreement(ridges, whole, longest, frame.spacing)),
        "sdf_loss": _mean_value(source, predicted),
        "mask_overlap": _mask_overlap(context, vertices, triangles),
        "gates": gates.gates(mesh, defects, expected),
        "defects": defects.named(),
    }
    context.progress.advance(4)
    if params.surface is None and params.of in ("sphere-train", "volume"):
        metrics |= _trained(context, samples, radius, source)
        with foreign("sphere-train.json"):
            trained = context.folder.manifest("sphere-train") or {}
            claimed = trained["metrics"]["certificate"]["holds"]
        metrics["gates"]["certificate"] = (
            metrics["certificate"]["holds"] if claimed else "not claimed by the training"
        )
    at = frame.model_from_input(mesh.vertices)
    distance = frame.spacing * np.linalg.norm(at - truth.closest(at)[0], axis=1)
    bend = np.where(valid, np.abs(measured), np.nan)[: mesh.vertex_count]
    files = {
        "ply": ply.encode(
            mesh, {"distance": distance, "mean_curvature": np.nan_to_num(bend, nan=-1.0)}
        )
    }
    if defects.count:
        files["defects.ply"] = ply.encode(*defects.mesh(mesh))
    return Outcome(
        arrays={
            **mesh.as_arrays("surface/"),
            "vertex_distance": distance,
            "mean_curvature": bend,
        },
        files=files,
        metrics=metrics,
        warnings=warnings,
    )


def _comparable(name: str, source: Source, corners: Floats, box: Floats) -> list[str]:
    """Reasons why the comparison of a surface, given by its ``corners``, with a reference is
    doubtful.

    Raises InputError if the two cannot be compared.
    """
    import numpy as np

    own = np.stack([corners.min(axis=0), corners.max(axis=0)])
    larger = float(np.linalg.norm(own[1] - own[0]) / np.linalg.norm(box[1] - box[0]))
    if larger > OTHER_UNITS or larger < 1 / OTHER_UNITS:
        raise InputError(
            f"{name}: the surface is {larger:.4g} times as large as this reference, so their "
            "units differ; scale one of them"
        )
    if (own[0] > box[1]).any() or (own[1] < box[0]).any():
        raise InputError(
            f"{name}: the boxes of this reference, {_box(box)}, and of the surface, {_box(own)}, "
            "do not overlap; move one of them"
        )
    warnings = []
    if larger > OTHER_SIZE or larger < 1 / OTHER_SIZE:
        warnings.append(
            f"the surface is {larger:.3g} times as large as the reference {name}: the "
            "figures are meaningless unless both are the same whole shape in the same units"
        )
    warnings += [f"the reference {name}: {said}" for said in source.remarks()]
    holes = source.open_edges
    if holes:
        warnings.append(
            f"the reference {name} has holes ({holes} edges in one triangle only): the "
            "surface that closes them counts as wrong in CD^2 and F1, and the Euler numbers "
            "cannot be compared; close the reference"
        )
    return warnings


def _box(box: Floats) -> str:
    return " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in box)


def _mask_overlap(context: Context, vertices: Floats, triangles: Ints) -> dict[str, Any] | None:
    """For a run on views: intersection over union of the masks and the surface as the cameras see
    it."""
    recorded = context.folder.manifest("classify")
    if recorded is None or recorded["inputs"][0]["kind"] != "views":
        return None
    from .inputs.views.overlap import overlaps
    from .inputs.views.source import ViewSource

    source = context.source()
    assert isinstance(source, ViewSource)
    source.threads = context.threads
    found = overlaps(source.views, vertices, triangles)
    return {"mean": float(found.mean()), "worst": float(found.min())}


def _surface(context: Context) -> PolygonMesh:
    """The surface that is measured. Raises InputError for a file without a surface."""
    from .mesh.polygons import PolygonMesh

    params = context.params
    if params.surface is not None:
        from .formats.mesh_file import load

        return load(Path(params.surface)).polygons
    arrays = context.arrays(params.of)
    mesh = PolygonMesh.from_arrays(arrays, "" if params.of == "volume" else "surface/")
    if params.of == "volume":
        mesh = mesh.select_faces(arrays["face_neighbour"] < 0).without_unused_vertices()
    return mesh


def _mean_value(source: Source, points: Floats) -> float | None:
    """The mean of ``|F|`` at ``points (N, 3)``, where the source is the zero set of F."""
    import numpy as np

    values = source.value(points)
    return None if values is None else float(np.abs(values).mean())


def _trained(context: Context, samples: int, radius: float, source: Source) -> dict[str, Any]:
    """Figures of the trained polygons, and conformity and certificate computed again from the
    files."""

    from .mesh import geometry
    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import PolygonMesh
    from .mesh.topology import topology
    from .metrics import curvature
    from .voronoi.conformity import conformity
    from .voronoi.trained_surface import TrainedSurface

    arrays = context.arrays("sphere-train")
    frame = ModelFrame.of(context.arrays("classify"))
    mesh = PolygonMesh.from_arrays(arrays, "trained/")
    vertices, triangles, _ = geometry.fan_triangles(mesh)
    measured, valid = curvature.mean_curvature(vertices, triangles, radius, context.threads)
    bent = curvature.statistics(vertices, triangles, radius, measured, valid)
    points, _ = geometry.sample_triangles(vertices, triangles, samples, context.random("trained"))
    loss = _mean_value(source, points)
    trained = TrainedSurface.stored(arrays, frame)
    certificate = trained.certificate(context.threads)
    agreement = conformity(trained.interface(), trained, context.threads)
    return {
        "certificate": vars(certificate) | {"failed": list(certificate.failed)},
        "conformity": vars(agreement),
        "trained": {
            "topology": vars(topology(mesh)),
            "curvature": None if bent is None else vars(bent),
            "dihedral_mean_curvature": curvature.dihedral_mean_curvature(mesh),
            "sdf_loss": loss,
        },
    }


def _extra(params: Params) -> dict[str, str]:
    given = {"surface": params.surface, "reference": params.reference}
    return {role: text for role, text in given.items() if text is not None}


def _parents(params: Params) -> tuple[str, ...]:
    if params.surface is not None:
        return ("classify",)
    trained = () if params.of in ("init", "baseline") else ("sphere-train",)
    return tuple(dict.fromkeys(("classify", *trained, params.of)))


def _stem(params: Params) -> str:
    of = f"file-{packed.stem(Path(params.surface))}" if params.surface else params.of
    return f"evaluate-{of}"


def _memory(context: Context) -> float:
    from .metrics.protocols import PROTOCOLS

    params = context.params
    samples = params.samples or PROTOCOLS[params.protocol].samples
    if params.surface is not None:
        path = Path(params.surface)
        corners = path.stat().st_size // 8 if path.is_file() else 0
    else:
        # The surface of stage volume is the trained one.
        of = "sphere-train" if params.of == "volume" else params.of
        corners = len(context.arrays(of)["surface/face_vertices"])
    return peak(500.0, 300.0 + 1e-4 * samples, 6.0, corners)


STAGE = Stage(
    name="evaluate",
    version=6,
    params=Params,
    run=run,
    parents=_parents,
    reads_input=True,
    stem=_stem,
    extra_inputs=_extra,
    memory=_memory,
)
