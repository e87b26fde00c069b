"""The volume stage with a growing number of inner cells: time, memory and CVT energy.

Run with ``make bench-volume INPUT=bunny.obj INNER_COUNTS="800 20000 100000"``. The energy is
compared with that after many more steps, and with that of as many steps of Lloyd's iteration. If
OpenFOAM is installed, its checkMesh checks the cells, and its laplacianFoam solves a problem with a
known solution.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from results import write

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polyhedra import PolyhedralMesh
from vorolight.stages.metrics.polyhedra import face_centres, quality
from vorolight.stages.training.cvt import Descent
from vorolight.stages.voronoi.cells.interior import Guard
from vorolight.stages.voronoi.cells.moments import cell_moments

SKEWED = 4
"""Skewness of a face above which checkMesh warns."""
DEBIAN = Path("/usr/share/openfoam")
"""The folder with the settings of Debian's OpenFOAM, which it does not find by itself."""


def call(*words: object) -> None:
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr.strip()[-300:]}")


def energy(guard: Guard, points: np.ndarray, threads: int) -> float:
    """The energy of all cells inside the surface. Cells of its own generators
    end at the outside ones."""
    everything = np.concatenate([points, guard.within, guard.generators[~guard.inside]])
    count = len(points) + len(guard.within)
    return float(cell_moments(everything, count, threads=threads).energy.sum())


def lloyd(guard: Guard, points: np.ndarray, steps: int, threads: int) -> np.ndarray:
    for _ in range(steps):
        generators = np.concatenate([points, guard.within])
        moments = cell_moments(generators, len(points), threads=threads)
        points = guard.moved(points, moments.centroid - points, threads)
    return points


def convergence(run: Path, long: int, threads: int) -> dict[str, Any]:
    """The energies after the steps of the stage, after many more, and after
    Lloyd's from the same start."""
    folder = RunFolder(run)
    frame = ModelFrame.of(folder.arrays("classify", "classify"))
    arrays, trained = (folder.arrays(stage, stage) for stage in ("volume", "sphere-train"))
    within = frame.model_from_input(trained["generators/inside"])
    without = frame.model_from_input(trained["generators/outside"])
    guard = Guard(
        np.concatenate([within, without]),
        np.arange(len(within) + len(without)) < len(within),
        frame.model_from_input(trained["spheres/center"]),
        trained["spheres/radius"] / frame.spacing,
    )
    points = frame.model_from_input(arrays["generators"][arrays["generator_role"] == 2])
    reached = energy(guard, points, threads)
    steps = len(arrays["history"]) - 1
    further = Descent(guard, None, threads, points)
    for _ in range(long):
        further.step()
    # Both start from random points.
    random = np.random.default_rng(0)
    start = guard.moved(points, random.normal(size=points.shape), threads)
    timed: dict[str, Any] = {}
    begun = time.perf_counter()
    descent = Descent(guard, None, threads, start)
    for _ in range(steps):
        descent.step()
    timed["quasi_newton_seconds"] = round(time.perf_counter() - begun, 2)
    timed["quasi_newton_energy"] = energy(guard, descent.points, threads)
    begun = time.perf_counter()
    slow = lloyd(guard, start, steps, threads)
    timed["lloyd_seconds"] = round(time.perf_counter() - begun, 2)
    timed["lloyd_energy"] = energy(guard, slow, threads)
    return {
        "steps": steps,
        "energy_over_long_run": reached / energy(guard, further.points, threads),
        **timed,
    }


def foam(program: str, case: Path, *words: str) -> str:
    """The output of a program of OpenFOAM."""
    places = {"WM_PROJECT_DIR": str(DEBIAN)} if DEBIAN.is_dir() else {}
    done = subprocess.run(
        [program, *words], cwd=case, capture_output=True, text=True, env={**places, **os.environ}
    )
    if "End" not in done.stdout.split():
        raise SystemExit(f"{program}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return done.stdout


def check_mesh(case: Path) -> dict[str, Any]:
    """The complaints of checkMesh."""
    lines = [line.strip() for line in foam("checkMesh", case, "-allTopology").splitlines()]
    return {
        "said": [line for line in lines if line.startswith(("*", "Failed"))],
        "passed": "Mesh OK." in lines,
    }


def harmonic(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return x**2 - y**2 + 2 * x * z + z


def laplace(case: Path, mesh: PolyhedralMesh, points: np.ndarray) -> float:
    """Root mean square error of laplacianFoam, divided by the root mean square of
    ``harmonic``, the exact solution."""

    def write(place: str, kind: str, text: str) -> None:
        folder, name = place.split("/")
        (case / folder).mkdir(exist_ok=True)
        head = f'version 2.0; format ascii; class {kind}; location "{folder}"; object {name};'
        (case / place).write_text(f"FoamFile {{ {head} }}\n{text}\n")

    values = harmonic(face_centres(mesh.boundary)[1])
    listed = f"{len(values)} ( {' '.join(map(repr, values.tolist()))} )"
    fixed = f"type fixedValue; value nonuniform List<scalar> {listed};"
    write(
        "0/T", "volScalarField",
        "dimensions [0 0 0 1 0 0 0]; internalField uniform 0;\n"
        f"boundaryField {{ surface {{ {fixed} }} }}",
    )  # fmt: skip
    write("constant/transportProperties", "dictionary", "DT DT [0 2 -1 0 0 0 0] 1;")
    write(
        "system/controlDict", "dictionary",
        "application laplacianFoam; startFrom startTime; startTime 0; stopAt endTime; endTime 1;"
        "deltaT 1; writeControl timeStep; writeInterval 1; writePrecision 12; writeFormat ascii;",
    )  # fmt: skip
    write(
        "system/fvSolution", "dictionary",
        "solvers { T { solver PCG; preconditioner DIC; tolerance 1e-10; relTol 0; } }"
        "SIMPLE { nNonOrthogonalCorrectors 8; }",
    )  # fmt: skip
    foam("laplacianFoam", case)
    found = (case / "1" / "T").read_text().split("(", 1)[1].split(")", 1)[0]
    volume, centroid = mesh.solids(points)
    truth = harmonic(centroid)
    error = np.array(found.split(), float) - truth
    return float(np.sqrt((volume * error**2).sum() / (volume * truth**2).sum()))


def skewed(arrays: dict[str, Any], mesh: PolyhedralMesh) -> dict[str, Any]:
    """The faces with a skewness above 4: their number, the cells beside them, and their size."""
    found = quality(mesh)
    bad = np.flatnonzero(found.skewness > SKEWED)
    inner = arrays["generator_role"][mesh.cell_generator] == 2
    both = bad[mesh.neighbour[bad] >= 0]
    count = inner[mesh.owner[both]].astype(int) + inner[mesh.neighbour[both]]
    area = found.face_area[mesh.neighbour >= 0]
    return {
        "faces": mesh.faces.face_count,
        "skewed": len(bad),
        "between_surface_cells": int((count == 0).sum()),
        "median_area_ratio": float(np.median(found.face_area[bad]) / np.median(area))
        if len(bad)
        else None,
    }


def opened(run: Path, programs: bool) -> dict[str, Any]:
    """Figures of the cells, and the results of OpenFOAM with them."""
    arrays = RunFolder(run).arrays("volume", "volume")
    mesh = PolyhedralMesh.from_arrays(arrays)
    found: dict[str, Any] = {"skewness_above_4": skewed(arrays, mesh)}
    if programs:
        case = run.parent / "case"
        shutil.rmtree(case, ignore_errors=True)
        call("export", case, "--format", "openfoam", "--run", run)
        found["check_mesh"] = check_mesh(case)
        found["laplace_error"] = laplace(case, mesh, arrays["generators"][mesh.cell_generator])
    return found


def row(run: Path, words: list[object], long: int, threads: int) -> dict[str, Any]:
    call("volume", "--run", run, "--force", "--quiet", *words)
    record = json.loads((run / "volume.json").read_text())
    metrics, volatile = record["metrics"], record["volatile"]
    distributions = metrics["quality"]
    found: dict[str, Any] = {
        "options": " ".join(map(str, words)),
        "inner": metrics["inner_generators"],
        "cells": metrics["cells"],
        "seconds": round(volatile["wall_seconds"], 1),
        "peak_memory_mb": round(volatile["peak_memory_mb"]),
        "faults": sum(metrics["faults"].values()),
        **{
            key: metrics[key]
            for key in (
                "volume_error", "centroid_distance_mean", "surface_to_inner_size",
                "neighbours_within_factor_2",
            )
        },
        "non_orthogonality_max": distributions["non_orthogonality"]["most"],
        "skewness_p99": distributions["skewness"]["p99"],
        "skewness_max": distributions["skewness"]["most"],
    }  # fmt: skip
    found |= opened(run, shutil.which("checkMesh") is not None)
    if long and "--grading" not in words:
        found |= convergence(run, long, threads)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape")
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--inner", type=int, nargs="+", default=[800, 20_000])
    parser.add_argument("--grading", type=float, default=0.3)
    parser.add_argument("--long", type=int, default=40, help="more steps, to see what they win")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        call("classify", given.shape, "-n", given.n, "--run", run, "--quiet")
        call("init", "--run", run, "--quiet")
        call("sphere-train", "--run", run, "--quiet")
        options: list[list[object]] = [["--inner", count] for count in given.inner]
        for words in [*options, ["--grading", given.grading]]:
            rows.append(row(run, words, given.long, given.threads))
            print(json.dumps(rows[-1]), flush=True)
    write(f"volume-{Path(given.shape).stem}", rows)


if __name__ == "__main__":
    main()
