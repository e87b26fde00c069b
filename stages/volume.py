"""Stage volume: generators deep inside, a centroidal tessellation, polyhedral cells.

Example:
    >>> from vorolight.stages import pipeline, volume
    >>> pipeline.execute(session, "volume", volume.Params(inner=800))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from . import contract
from .contract import Context, Outcome, Range, Stage
from .memory import peak

CHECKPOINT_EVERY = 10


MERGE = 1e-6
"""In units of h0: edges shorter than this are contracted in the cells of a certified surface."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the volume stage."""

    inner: Annotated[int, Range(1, 10_000_000)] = 800
    """Generators to place inside, away from the surface."""
    cvt_iterations: Annotated[int, Range(0, 100_000)] = 100
    """Most steps towards a centroidal Voronoi tessellation of the inner generators; they end before
    where five win less than a thousandth of its energy."""


def run(context: Context) -> Outcome:
    """The paper's section 3.6 and appendix C.2; quasi-Newton steps lower the CVT energy."""
    import numpy as np

    from .errors import NumericalFailure
    from .export import vtu
    from .optimize.cvt import Descent
    from .surface.geometry import enclosed_volume, face_frames, fan_triangles
    from .surface.model_frame import ModelFrame
    from .surface.polygons import PolygonMesh
    from .voronoi.cells import open_cells, polyhedral_mesh
    from .voronoi.certificate import MARGIN, certify
    from .voronoi.delaunay import delaunay
    from .voronoi.interface import interface
    from .voronoi.interior import Guard, sample
    from .voronoi.unchanged import same_surface

    params = context.params
    trained = context.arrays("sphere-train")
    frame = ModelFrame.of(context.arrays("classify"))
    within = frame.model_from_input(trained["generators/inside"])
    without = frame.model_from_input(trained["generators/outside"])
    boundary = np.concatenate([within, without])
    labels = np.arange(len(boundary)) < len(within)
    before = interface(boundary, labels)
    mesh_trained = PolygonMesh.from_arrays(trained, "trained/")
    mesh_trained = mesh_trained.with_vertices(frame.model_from_input(mesh_trained.vertices))
    radii = trained["spheres/radius"] / frame.spacing
    recorded = context.folder.manifest("sphere-train") or {}
    certified = bool(recorded["metrics"]["certificate"]["holds"])
    if certified:
        # As far outside the spheres as the certificate asks.
        guard = Guard(boundary, labels, mesh_trained.vertices, np.sqrt(radii**2 + 2 * MARGIN))
    else:
        guard = Guard.of(boundary, labels, before)
    mean_area = float(face_frames(before.mesh)[0].mean())

    found = context.checkpoints.latest()
    if found is not None:
        descent = Descent.resumed(guard, None, context.threads, found[1])
    else:
        context.progress.start("inner generators", params.inner)
        points = sample(
            guard, params.inner, context.random, context.threads, context.progress.advance
        )
        descent = Descent(guard, None, context.threads, points)
        context.checkpoints.save(0, descent.state())
    context.progress.start("volume", params.cvt_iterations)
    while len(descent.won) < params.cvt_iterations and not descent.done:
        descent.step()
        iteration = len(descent.won)
        context.progress.advance(iteration, f"CVT loss {descent.residuals[-1] / mean_area:.3g}")
        if iteration % CHECKPOINT_EVERY == 0:
            context.checkpoints.save(iteration, descent.state())
    points = descent.points
    history = np.array([*descent.residuals, descent.residual]) / mean_area
    size = float(np.cbrt(descent.moments.volume.mean()))
    offset = np.linalg.norm(points - descent.moments.centroid, axis=1)

    generators = np.concatenate([points, boundary])
    inside = np.concatenate([np.ones(len(points), bool), labels])
    diagram = delaunay(generators)
    if certified:
        # The certificate is against all generators: with it the surface is the same to the bit.
        count = mesh_trained.face_count
        ends = len(points) + np.stack([np.arange(count), count + np.arange(count)], axis=1)
        found_now = certify(mesh_trained, radii, generators, inside, ends, context.threads)
        difference = (
            None
            if found_now.holds
            else "the certificate fails (" + ", ".join(found_now.failed) + ")"
        )
    else:
        after = interface(generators, inside, diagram)
        difference = same_surface(before, after, boundary, len(points))
    if difference is not None:
        raise NumericalFailure(f"the inner generators changed the surface: {difference}")
    mesh = polyhedral_mesh(generators, inside, diagram, MERGE if certified else 0.0)
    unclosed = open_cells(mesh)
    volume = float(mesh.cell_volume.sum())
    surface = PolygonMesh.from_arrays(trained, "surface/")
    surface = surface.with_vertices(frame.model_from_input(surface.vertices))
    enclosed = enclosed_volume(*fan_triangles(surface)[:2])
    role = np.where(inside, 1, 0)
    role[: len(points)] = 2
    warnings = [f"{unclosed} cells are not closed"] if unclosed else []
    placed = mesh.faces.with_vertices(frame.input_from_model(mesh.faces.vertices))
    scale = frame.spacing**3
    data = {
        "generator": mesh.cell_generator,
        "role": role[mesh.cell_generator],
        "volume": mesh.cell_volume * scale,
    }
    output = type(mesh)(
        placed, mesh.owner, mesh.neighbour, mesh.cell_generator, mesh.cell_volume * scale
    )
    return Outcome(
        arrays={
            "generators": frame.input_from_model(generators),
            "generator_role": role,
            **placed.as_arrays(),
            "face_owner": mesh.owner,
            "face_neighbour": mesh.neighbour,
            "cell_generator": mesh.cell_generator,
            "cell_volume": output.cell_volume,
            "history": history,
        },
        files={"vtu": vtu.encode(output, data)},
        metrics={
            "inner_generators": len(points),
            "cells": len(mesh.cell_generator),
            "faces": placed.face_count,
            "boundary_faces": int((mesh.neighbour < 0).sum()),
            "open_cells": unclosed,
            "surface_unchanged": True,
            "cell_volume_sum": volume * scale,
            "enclosed_volume": enclosed * scale,
            "volume_error": abs(volume / enclosed - 1),
            "smallest_cell_volume": float(mesh.cell_volume.min()) * scale,
            "cvt_iterations": len(history) - 1,
            "cvt_converged": descent.done,
            "cvt_loss_first": float(history[0]),
            "cvt_loss_last": float(history[-1]),
            "inner_cell_size": size * frame.spacing,
            "centroid_distance_mean": float(offset.mean()) / size,
            "centroid_distance_max": float(offset.max()) / size,
        },
        warnings=warnings,
    )


def _memory(context: Context) -> float:
    boundary = 2 * len(context.arrays("sphere-train")["generators/inside"])
    return peak(200.0, 100.0, 11.0, boundary + context.params.inner)


STAGE = Stage(
    name="volume",
    version=4,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "sphere-train"),
    memory=_memory,
)
