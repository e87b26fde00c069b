"""Stage volume: fill the surface with Voronoi cells, a polyhedral mesh.

Example:
    >>> from vorolight.stages import volume
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "volume", volume.Params(inner=800))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from .engine.params import Range, Share, StageParams
from .engine.stage import Context, Outcome, Stage
from .memory import peak

if TYPE_CHECKING:
    from collections.abc import Callable

    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import Floats, PolygonMesh
    from .training.cvt import Descent, PaperDescent
    from .voronoi.cells.boundary import Boundary
    from .voronoi.cells.grading import Sizes
    from .voronoi.cells.interior import Guard
    from .voronoi.diagram.cleanup import CleanSurface
    from .voronoi.diagram.interface import VoronoiSurface

DEFAULT_INNER = 800
MOST_INNER = 10_000_000
SAME = 1e-6
"""Largest distance, in h0, of the written surface from the interface of its generators."""
BELOW = 0.55
"""How far cells of the surface reach below their generators, about, as a share of their size."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the volume stage."""

    inner: Annotated[int, Range(1, MOST_INNER)] | None = None
    """Number of generators inside. Default: 800, or fewer if the shape is too thin for these, or
    as many as --spacing and --grading need."""
    spacing: Annotated[float, Range(0)] | None = None
    """Size of the inner cells (the cube root of their volume, in the unit of the input), in place
    of --inner. With --grading it is the largest size."""
    grading: Share = 0.0
    """Growth of the cell size per unit of distance to the surface, starting from the size of the
    surface's faces. 0 makes all inner cells the same size."""
    cvt: Literal["energy", "paper"] = "energy"
    """How inner cells are evened out: energy by quasi-Newton steps on the energy of the centroidal
    Voronoi tessellation, paper by Adam on the paper's loss (without --grading)."""
    cvt_iterations: Annotated[int, Range(0, 100_000)] = 100
    """Maximum number of these steps. With --cvt energy they end early if five steps gain less than
    a thousandth."""
    sliver: Annotated[float, Range(0, 0.2)] = 0.01
    """Contract inner edges shorter than this share of the smallest cell beside them, and faces
    smaller than its square."""


def run(context: Context) -> Outcome:
    """Place inner generators and make the cells (the paper's section 3.6 and appendix C.2).

    Quasi-Newton steps lower the CVT energy.
    """
    import numpy as np

    from .errors import InputError, NumericalFailure, UsageError
    from .formats import vtu
    from .mesh.geometry import enclosed_volume, face_frames, fan_triangles
    from .mesh.model_frame import ModelFrame
    from .mesh.polygons import PolygonMesh
    from .mesh.topology import bad_edges
    from .metrics import polyhedra
    from .voronoi.cells.assembly import raw_cells
    from .voronoi.cells.slivers import merged
    from .voronoi.diagram.delaunay import delaunay

    params = context.params
    if params.spacing == 0:
        raise UsageError("--spacing 0: must be more than 0")
    if params.spacing is not None and params.inner is not None:
        raise UsageError(
            "--spacing and --inner both set the number of inner generators; give one of them"
        )
    if params.grading and params.cvt == "paper":
        raise UsageError("--grading: --cvt paper makes cells of one size only; use --cvt energy")
    trained = context.arrays("sphere-train")
    frame = ModelFrame.of(context.arrays("classify"))
    written = PolygonMesh.from_arrays(trained, "surface/")
    gaps = len(bad_edges(written))
    if gaps or not written.face_count:
        raise InputError(
            f"{context.folder.file('sphere-train', 'ply')}: the surface is not closed "
            f"({gaps} edges are not in two faces); train it again with a larger -n"
        )
    surface = written.with_vertices(frame.model_from_input(written.vertices))
    mean_area = float(face_frames(surface)[0].mean())
    bounded = _bounded(context, frame, surface)
    sizes, count = _sizes(params, frame, surface, bounded.guard, context.threads)
    descent = _descend(context, bounded.guard, count, sizes, mean_area)
    points = descent.points

    generators = np.concatenate([points, bounded.guard.generators])
    inside = np.concatenate([np.ones(len(points), bool), bounded.guard.inside])
    bounded.recheck(points)
    diagram = delaunay(generators)
    warnings, as_written, changed = list(bounded.warnings), True, 0
    if len(points) < count:
        warnings.append(
            f"{len(points)} inner generators fit in place of {count}, because the shape is thin, "
            "so that most cells end at the surface; raise -n for smaller cells"
        )
    try:
        raw = raw_cells(generators, inside, diagram, bounded.boundary, len(points))
    except NumericalFailure:
        if bounded.again is None:
            raise
        # Where many generators lie on one sphere, the new diagram divides it in another way than
        # before.
        actual, changed = bounded.again(generators, inside, diagram)
        raw = raw_cells(generators, inside, diagram, actual)
        surface, as_written = actual.mesh, False
        if changed:
            warnings.append(
                f"{changed} outer faces of the cells have other corners than in the written "
                "surface, whose diagram is degenerate there; train the surface until it has "
                "a certificate if cells must end exactly at it"
            )
    at = generators[raw.cell_generator]
    result = merged(raw, params.sliver, at)
    mesh = result.mesh
    volume, _ = mesh.solids(at)
    enclosed = enclosed_volume(*fan_triangles(surface)[:2])
    role = np.where(inside, 1, 0)
    role[: len(points)] = 2

    faults = {name: cells for name, cells in result.faults.items() if cells}
    if faults:
        named = ", ".join(f"{cells} {name.replace('_', ' ')}" for name, cells in faults.items())
        warnings.append(
            f"some cells are faulty ({named}), and a solver may refuse them: lower --sliver, or "
            "train the surface until it has a certificate"
        )
    if params.cvt == "energy" and params.cvt_iterations and not descent.done:
        warnings.append(
            f"the CVT energy was still falling after {descent.taken} steps: raise --cvt-iterations"
        )
    bodies = mesh.body_count
    if bodies > 1:
        warnings.append(f"the cells form {bodies} separate bodies that share no face")
    moments = descent.moments
    offset = np.linalg.norm(points - moments.centroid, axis=1)
    history = np.array([*descent.residuals, (offset**2).mean()]) / mean_area
    inner_size = float(np.cbrt(moments.volume.mean()))

    placed = frame.input_from_model(mesh.faces.vertices)
    if as_written:  # The surface's vertices are those of the file, to the last bit.
        placed[: written.vertex_count] = written.vertices
    output = mesh.with_vertices(placed)
    found = polyhedra.quality(output)
    cell_role = role[mesh.cell_generator]
    scale = frame.spacing**3
    data = polyhedra.cell_data(mesh, cell_role, volume * scale, found)
    of_surface = np.cbrt(volume[cell_role == 1]).mean()
    of_inner = np.cbrt(volume[cell_role == 2]).mean()
    smallest = face_frames(mesh.faces)[0]
    return Outcome(
        arrays={
            "generators": frame.input_from_model(generators),
            "generator_role": role,
            **output.faces.as_arrays(),
            "face_owner": mesh.owner,
            "face_neighbour": mesh.neighbour,
            "cell_generator": mesh.cell_generator,
            "cell_volume": volume * scale,
            "history": history,
        },
        files={"vtu": vtu.encode(output, data)},
        metrics={
            "inner_generators": len(points),
            "cells": mesh.cell_count,
            "bodies": bodies,
            "faces": mesh.faces.face_count,
            "boundary_faces": int((mesh.neighbour < 0).sum()),
            "faults": result.faults,
            "surface_unchanged": as_written,
            "changed_faces": changed,
            "cell_volume_sum": float(volume.sum()) * scale,
            "enclosed_volume": enclosed * scale,
            "volume_error": abs(float(volume.sum()) / enclosed - 1),
            "smallest_cell_volume": float(volume.min()) * scale,
            "slivers": {
                "contracted_vertices": result.contracted_vertices,
                "spared_vertices": result.spared_vertices,
                "smallest_face_area": float(smallest.min()) * frame.spacing**2,
            },
            "cvt_iterations": descent.taken,
            "cvt_converged": descent.done,
            "cvt_loss_first": float(history[0]),
            "cvt_loss_last": float(history[-1]),
            "inner_cell_size": inner_size * frame.spacing,
            "surface_to_inner_size": float(of_surface / of_inner),
            "neighbours_within_factor_2": float((found.size_ratio < 2).mean()),
            "centroid_distance_mean": float(offset.mean()) / inner_size,
            "centroid_distance_max": float(offset.max()) / inner_size,
            "quality": polyhedra.summary(found),
        },
        warnings=warnings,
    )


@dataclass(frozen=True)
class _Bounded:
    """What inner generators must not touch, and the surface at which their cells end."""

    guard: Guard
    boundary: Boundary
    recheck: Callable[[Floats], None]
    """Called with the inner generators. Raises NumericalFailure if they change the surface."""
    warnings: list[str]
    again: Callable[[Floats, Any, Any], tuple[Boundary, int]] | None = None
    """Called with all generators, their labels and their diagram. It returns the actual boundary
    and the number of faces that differ from the written ones. None if there is a certificate."""


def _bounded(context: Context, frame: ModelFrame, surface: PolygonMesh) -> _Bounded:
    """The bounds from the trained surface if the certificate holds, else from the actual
    interface."""
    import numpy as np

    from .artifacts.manifest import foreign
    from .errors import NumericalFailure
    from .voronoi.cells.boundary import Boundary
    from .voronoi.cells.interior import Guard
    from .voronoi.certificate import MARGIN
    from .voronoi.diagram.cleanup import clean
    from .voronoi.diagram.interface import interface
    from .voronoi.trained_surface import TrainedSurface

    trained = TrainedSurface.stored(context.arrays("sphere-train"), frame)
    boundary, labels = trained.generators, trained.labels
    with foreign("sphere-train.json"):
        recorded: dict[str, Any] = context.folder.manifest("sphere-train") or {}
        metrics = recorded["metrics"]
        certified, merged = bool(metrics["certificate"]["holds"]), float(metrics["merged_within"])
        reach = float(recorded["params"]["merge"])
        failed = ", ".join(metrics["certificate"].get("failed") or [])
    if certified:
        # As far outside the spheres as the certificate requires.
        reaches = np.sqrt(trained.radii**2 + 2 * MARGIN)
        guard = Guard(boundary, labels, surface.vertices, reaches)

        def still_certified(points: Floats) -> None:
            found = trained.certificate(context.threads, points)
            if not found.holds:
                raise NumericalFailure(
                    "the inner generators changed the surface: the certificate fails ("
                    + ", ".join(found.failed) + ")"
                )  # fmt: skip

        return _Bounded(guard, Boundary.certified(surface), still_certified, [])

    raw = trained.interface()
    drawn = merged > 0

    def cleaned(raw: VoronoiSurface) -> CleanSurface:
        """Clean the interface as stage sphere-train did."""
        return clean(
            raw, 1.0, anchors=trained.polygons.vertices if drawn else None,
            reach=reach if drawn else 0.0,
        )  # fmt: skip

    def again(generators: Floats, inside: Any, diagram: Any) -> tuple[Boundary, int]:
        now = interface(generators, inside, diagram)
        found = cleaned(now)
        actual = Boundary.cleaned(now, inside, found, found.mesh, SAME)
        assert actual is not None  # it is compared with itself
        assert made is not None
        added = len(generators) - len(boundary)
        keys = [
            ends @ np.array([len(generators), 1])
            for ends in (actual.generators, made.generators + added)
        ]
        _, here, there = np.intersect1d(*keys, return_indices=True)
        other = int((actual.mesh.valences[here] != made.mesh.valences[there]).sum())
        return actual, actual.mesh.face_count - len(here) + other

    made = Boundary.cleaned(raw, labels, cleaned(raw), surface, SAME)
    if made is None:
        raise NumericalFailure(
            f"{context.folder.file('sphere-train', 'ply')}: is not the interface of its "
            "generators, and has no certificate; train it without --preset paper, or with --merge 0"
        )
    warning = (
        f"the surface has no certificate ({failed} fails): the cells end at the interface of "
        "its generators, which may differ from the trained surface"
    )
    guard = Guard.of(boundary, labels, raw)
    return _Bounded(guard, made, lambda points: None, [warning], again)


def _sizes(
    params: Params, frame: ModelFrame, surface: PolygonMesh, guard: Guard, threads: int
) -> tuple[Sizes | None, int]:
    """The cell sizes for --grading (None if all are equal), and the number of inner cells."""
    import math

    import numpy as np

    from .errors import InputError
    from .mesh.geometry import face_frames
    from .voronoi.cells.grading import Sizes, depths

    if params.spacing is None and not params.grading:
        return None, params.inner or DEFAULT_INNER
    most = math.inf if params.spacing is None else params.spacing / frame.spacing
    own = math.sqrt(float(face_frames(surface)[0].mean()))
    least = min(own, most) if params.grading else most
    sizes = Sizes(least, params.grading, most, depths(surface, guard, threads))
    if params.inner is not None:
        return sizes, params.inner
    half = len(guard.generators) // 2
    offset = float(np.linalg.norm(guard.generators[:half] - guard.generators[half:], axis=1).mean())
    # Cells of the surface end where those of the first inner generators begin.
    below = (offset / 2 + BELOW * least) / max(1 - BELOW * params.grading, BELOW)
    wanted = sizes.count(min(below, offset / 2 + BELOW * most))
    if not 1 <= wanted <= MOST_INNER:
        asked = (
            f"--spacing {params.spacing:g}" if params.spacing else f"--grading {params.grading:g}"
        )
        raise InputError(
            f"{asked}: asks for {wanted:.3g} inner generators, which must be "
            f"from 1 to {MOST_INNER}; {'lower' if wanted < 1 else 'raise'} it"
        )
    return sizes if params.grading else None, round(wanted)


def _descend(
    context: Context, guard: Guard, count: int, sizes: Sizes | None, mean_area: float
) -> Descent | PaperDescent:
    """Sample inner generators and even them out; continues from the newest checkpoint."""
    from .training.cvt import Descent, PaperDescent
    from .voronoi.cells.interior import sample

    params, threads = context.params, context.threads
    density = sizes.density() if sizes else None
    found = context.checkpoints.latest()
    descent: Descent | PaperDescent
    if found is not None:
        if params.cvt == "paper":
            descent = PaperDescent.resumed(
                guard, mean_area, threads, params.cvt_iterations, found[1]
            )
        else:
            descent = Descent.resumed(guard, density, threads, found[1])
    else:
        context.progress.start("inner generators", count)
        points = sample(
            guard, count, context.random, threads, context.progress.advance,
            sizes.places if sizes else None, fewer=sizes is None and params.inner is None,
        )  # fmt: skip
        if params.cvt == "paper":
            descent = PaperDescent(guard, points, mean_area, threads, params.cvt_iterations)
        else:
            descent = Descent(guard, density, threads, points)
        context.checkpoints.save(0, descent.state)
    context.progress.start("volume", params.cvt_iterations)
    while descent.taken < params.cvt_iterations and not descent.done:
        descent.step()
        loss = descent.residuals[-1] / mean_area
        context.progress.advance(descent.taken, f"CVT loss {loss:.3g}")
        context.checkpoints.save(descent.taken, descent.state)
    return descent


def _memory(context: Context) -> float:
    params, faces = context.params, len(context.arrays("sphere-train")["generators/inside"])
    inner = params.inner or 0
    if params.spacing:
        voxels = context.arrays("classify")
        inner += float(voxels["interior"].sum()) * (voxels["spacing"] / params.spacing) ** 3
    if params.grading and not params.inner:
        # Above each face cells grow from 1.5 times its size: the sum of that series.
        inner += faces / (4.5 * params.grading)
    return peak(300.0, 200.0, 25.0, faces + min(inner or DEFAULT_INNER, MOST_INNER))


STAGE = Stage(
    name="volume",
    version=4,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "sphere-train"),
    memory=_memory,
)
