"""Stage evaluate: what a stage's surface is worth, against the input or a reference.

Example:
    >>> from vorolight.stages import evaluate, pipeline
    >>> pipeline.execute(session, "evaluate", evaluate.Params(of="init"))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from . import contract
from .contract import Context, Outcome, Range, Stage
from .memory import peak

if TYPE_CHECKING:
    from .surface.polygons import Floats, Ints, PolygonMesh


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the evaluate stage."""

    of: Literal["init", "sphere-train", "volume"] = "sphere-train"
    """The stage whose surface is measured."""
    reference: str | None = None
    """A mesh file or built-in field to compare with; default: the input of the run."""
    samples: Annotated[int, Range(1000, 10_000_000)] = 50_000
    """Points on each surface."""
    threshold: Annotated[float, Range(1e-6, 1)] = 0.01
    """Distance for F1, with the reference's bounding-box diagonal as 1."""


def run(context: Context) -> Outcome:
    """The paper's appendix B under the protocol ``vorolight``: the reference's diagonal is 1."""
    import numpy as np

    from .export import ply
    from .metrics import chamfer, curvature
    from .metrics.fidelity import fidelity
    from .sources.fields import FieldSource
    from .sources.mesh import MeshSource
    from .sources.resolve import identify
    from .sources.true_surface import true_surface
    from .surface import geometry
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .surface.topology import topology

    params, threads = context.params, context.threads
    mesh = _surface(context, params.of)
    source: Any = (
        context.source() if params.reference is None else identify(params.reference).open()
    )
    context.progress.start("evaluate", 4)
    vertices, triangles, _ = geometry.fan_triangles(mesh)
    random = context.random
    predicted, _ = geometry.sample_triangles(
        vertices, triangles, params.samples, random("predicted")
    )
    reference = source.surface_samples(params.samples, random("reference"))
    field = source if isinstance(source, FieldSource) else None
    area = float(geometry.triangle_areas(vertices, triangles).sum())
    if field is None:
        low, high = source.bounding_box()
        true_area = float(geometry.triangle_areas(source.vertices, source.triangles).sum())
    else:  # a field's box is what is searched, not the shape's; its area is not known
        low, high = reference.min(axis=0), reference.max(axis=0)
        true_area = area
    diagonal = float(np.linalg.norm(high - low))
    distances = chamfer.chamfer(
        predicted / diagonal,
        reference / diagonal,
        params.threshold,
        true_area / diagonal**2,
        threads,
    )
    frame = ModelFrame.of(context.arrays("classify"))
    truth = true_surface(source, frame, threads)
    placed = frame.model_from_input(reference)
    close = fidelity(
        frame.model_from_input(vertices),
        triangles,
        truth,
        (placed, truth.closest(placed)[1]),
        params.samples,
        random("fidelity"),
        threads,
    ).scaled(frame.spacing / diagonal)
    context.progress.advance(1)
    spacing = float(context.arrays("classify")["spacing"])
    radius = 2.0 * source.median_edge_length() if isinstance(source, MeshSource) else spacing
    measured, valid = curvature.mean_curvature(vertices, triangles, radius, threads)
    bent = curvature.statistics(vertices, triangles, radius, measured, valid)
    context.progress.advance(2)
    facts = topology(mesh)
    volume = geometry.enclosed_volume(vertices, triangles)
    metrics: dict[str, Any] = {
        "of": params.of,
        "protocol": {
            "name": "vorolight",
            "samples": params.samples,
            "threshold": params.threshold,
            "frame": "bounding-box diagonal of the reference = 1",
            "diagonal": diagonal,
            "reference": source.name,
        },
        "topology": vars(facts),
        "area": area,
        "volume": volume,
        "chamfer": vars(distances),
        "fidelity": vars(close),
        "curvature": None if bent is None else vars(bent),
        "dihedral_mean_curvature": curvature.dihedral_mean_curvature(mesh),
        "reference_dihedral": None
        if not isinstance(source, MeshSource)
        else curvature.dihedral_mean_curvature(
            PolygonMesh.of_triangles(source.vertices, source.triangles)
        ),
        "reference_curvature": _reference_curvature(source, reference, radius, threads),
        "sdf_loss": float(np.abs(field.value(predicted)).mean()) if field else None,
        "mask_overlap": _mask_overlap(context, vertices, triangles),
        "gates": {
            "closed": facts.closed,
            "vertices_manifold": facts.pinched_vertices == 0,
            "outward": volume > 0,
            "self_intersection": "not run",
        },
    }
    context.progress.advance(3)
    if params.of != "init":
        metrics |= _trained(context, radius, field)
        if metrics["certificate"]["holds"]:
            metrics["gates"]["self_intersection"] = "excluded by the certificate"
        claimed = (context.folder.manifest("sphere-train") or {})["metrics"]["certificate"]["holds"]
        if claimed:
            metrics["gates"]["certificate"] = metrics["certificate"]["holds"]
    distance = chamfer.nearest(mesh.vertices, reference, threads)
    bend = np.where(valid, np.abs(measured), np.nan)[: mesh.vertex_count]
    return Outcome(
        arrays={
            **mesh.as_arrays("surface/"),
            "vertex_distance": distance,
            "mean_curvature": bend,
        },
        files={
            "ply": ply.encode(
                mesh, {"distance": distance, "mean_curvature": np.nan_to_num(bend, nan=-1.0)}
            )
        },
        metrics=metrics,
    )


def _mask_overlap(context: Context, vertices: Floats, triangles: Ints) -> dict[str, Any] | None:
    """Of a run on views: intersection over union of their masks and the surface as they see it."""
    recorded = context.folder.manifest("classify")
    if recorded is None or recorded["inputs"][0]["kind"] != "views":
        return None
    from .sources.images import ViewSource, overlaps

    source = context.source()
    assert isinstance(source, ViewSource)
    source.threads = context.threads
    found = overlaps(source.views, vertices, triangles)
    return {"mean": float(found.mean()), "worst": float(found.min())}


def _surface(context: Context, of: str) -> PolygonMesh:
    from .surface.polygons import PolygonMesh

    arrays = context.arrays(of)
    mesh = PolygonMesh.from_arrays(arrays, "" if of == "volume" else "surface/")
    if of == "volume":
        mesh = mesh.select_faces(arrays["face_neighbour"] < 0).without_unused_vertices()
    return mesh


def _reference_curvature(source: Any, samples: Any, radius: float, threads: int) -> Any:
    """|H| of the reference itself: what a smooth surface should reach."""
    import numpy as np

    from .metrics import curvature
    from .sources.fields import FieldSource

    if isinstance(source, FieldSource):
        size = np.abs(source.mean_curvature(samples))
        return {
            "mean": float(size.mean()),
            "median": float(np.median(size)),
            "p95": float(np.percentile(size, 95)),
            "method": "analytic",
        }
    bend, valid = curvature.mean_curvature(source.vertices, source.triangles, radius, threads)
    found = curvature.statistics(source.vertices, source.triangles, radius, bend, valid)
    return None if found is None else vars(found) | {"method": "quadric fit"}


def _trained(context: Context, radius: float, field: Any) -> dict[str, Any]:
    """The trained polygons' own figures, and conformity recomputed from the files."""
    import numpy as np

    from .metrics import curvature
    from .surface import geometry
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .surface.topology import topology
    from .voronoi.certificate import certify
    from .voronoi.conformity import conformity
    from .voronoi.interface import interface

    arrays = context.arrays("sphere-train")
    frame = ModelFrame.of(context.arrays("classify"))
    mesh = PolygonMesh.from_arrays(arrays, "trained/")
    vertices, triangles, _ = geometry.fan_triangles(mesh)
    measured, valid = curvature.mean_curvature(vertices, triangles, radius, context.threads)
    bent = curvature.statistics(vertices, triangles, radius, measured, valid)
    loss = None
    if field is not None:
        points, _ = geometry.sample_triangles(
            vertices, triangles, context.params.samples, context.random("trained")
        )
        loss = float(np.abs(field.value(points)).mean())
    count = mesh.face_count
    inside, outside = (
        frame.model_from_input(arrays[f"generators/{side}"]) for side in ("inside", "outside")
    )
    generators, labels = np.concatenate([inside, outside]), np.arange(2 * count) < count
    raw = interface(generators, labels)
    placed, radii = (
        mesh.with_vertices(frame.model_from_input(mesh.vertices)),
        arrays["spheres/radius"] / frame.spacing,
    )
    pairs = np.stack([np.arange(count), count + np.arange(count)], axis=1)
    certificate = certify(placed, radii, generators, labels, pairs, context.threads)
    agreement = conformity(
        raw,
        np.arange(2 * count) % count,
        placed,
        radii,
        inside,
        outside,
        1.0,
        context.threads,
    )
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


def failed_gates(metrics: dict[str, Any]) -> list[str]:
    """Gates of an evaluation that did not hold; gates that were not run do not count as held."""
    return [name for name, held in metrics["gates"].items() if held is False]


def _extra(params: Params) -> dict[str, str]:
    return {} if params.reference is None else {"reference": params.reference}


def _memory(context: Context) -> float:
    params = context.params
    # The volume's surface is the trained one's.
    of = "init" if params.of == "init" else "sphere-train"
    corners = len(context.arrays(of)["surface/face_vertices"])
    return peak(350.0, 210.0 + 1e-4 * params.samples, 6.0, corners)


STAGE = Stage(
    name="evaluate",
    version=3,
    params=Params,
    run=run,
    parents=lambda params: (
        tuple(dict.fromkeys(("classify", "sphere-train", params.of)))
        if params.of != "init"
        else ("classify", "init")
    ),
    reads_input=True,
    stem=lambda params: f"evaluate-{params.of}",
    extra_inputs=_extra,
    memory=_memory,
)
