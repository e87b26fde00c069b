"""The studies that the paper shows as pictures: noise, resolution, inner cells, the pipeline."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import panels
from runs import (
    POLYGON,
    TRIANGLE,
    Settings,
    attempt,
    cli,
    cpu_seconds,
    evaluated,
    metrics,
    started,
    table,
    trained,
)


def noise(given: Settings) -> str:
    """The study of noisy point clouds and weights of the losses, beside VoroMesh."""
    texts = []
    for path in given.meshes[: given.noise_shapes]:
        rows, pictured = [], {}
        ways = [(s, w) for s in given.shape_weights for w in given.normal_weights]
        for sigma in given.noise:
            cloud = _cloud(given, path, sigma)

            def ours(way: Any, path: Path = path, cloud: Path = cloud) -> dict[str, Any]:
                words = ("--weight-shape", way[0], "--weight-normal", way[1])
                name = f"shape{way[0]:g}-normal{way[1]:g}"
                run = trained(given, cloud, cloud.stem, given.noise_n, name, *TRIANGLE, *words)
                found = evaluated(given, run, "sphere-train", path)
                return found | {"run": run}

            def theirs(path: Path = path, cloud: Path = cloud) -> dict[str, Any]:
                run = started(given, cloud, f"{cloud.stem}-{given.noise_n}", given.noise_n)
                words = ["--epochs", given.epochs, "--grid", 8] if given.epochs else []
                cli("baseline", "voromesh", "--labels", path, "--run", run, *words)
                return evaluated(given, run, "baseline", path) | {"run": run}

            for way in ways:
                found = attempt(
                    f"noise: {path.stem}, {sigma:g} %, {way}", lambda way=way, ours=ours: ours(way)
                )
                pictured[sigma, way] = found
            pictured[sigma, None] = attempt(f"noise: {path.stem}, {sigma:g} %, VoroMesh", theirs)
        for sigma in given.noise:
            row = [f"{sigma:g} %", _noisy(pictured[sigma, None])]
            rows.append(row + [_noisy(pictured[sigma, way]) for way in ways])
        head = ["noise", "VoroMesh", *(f"shape {s:g}, normal {w:g}" for s, w in ways)]
        picture = panels.grid(
            [[_panel(pictured[sigma, way], 2 * given.panel // 3, path) for sigma in given.noise]
             for way in [None, *ways]],
            [f"{sigma:g} % of the diagonal" for sigma in given.noise],
            ["VoroMesh", *(f"weight of shape {s:g}, of normals {w:g}" for s, w in ways)],
        )  # fmt: skip
        name = f"noise-{path.stem}.png"
        panels.write(given.pictures / name, picture)
        texts.append(
            f"{path.stem}: F1@0.01 against the clean mesh, normal consistency, and Euler number "
            f"with components.\n\n{table(head, rows)}\n\n![{path.stem}, noise from left to "
            f"right]({name})"
        )
    return (
        "\n\n".join(texts)
        + f"\n\n{given.points:,} points sampled on the mesh and moved by Gaussian noise, in "
        f"percent of the diagonal; n = {given.noise_n}, triangles. The run sees only the points. "
        "VoroMesh gets its labels of inside and outside from the clean mesh, as in its own "
        "evaluation. Weights are those of this tool's training (`--weight-shape`, 100 by default, "
        "and `--weight-normal`, 0), which are not on the scale of the paper's."
    )


def _cloud(given: Settings, path: Path, sigma: float) -> Path:
    """A file of points of a mesh, with noise."""
    from vorolight.stages.inputs.mesh.source import MeshSource

    target = given.work / "clouds" / f"{path.stem}-noise{sigma:g}.npy"
    if not target.is_file():
        random = np.random.default_rng(0)
        source = MeshSource(path)
        low, high = source.bounding_box()
        points = source.surface_samples(given.points, random)
        shift = random.standard_normal(points.shape)
        target.parent.mkdir(parents=True, exist_ok=True)
        staging = target.with_suffix(".part.npy")
        np.save(staging, points + 0.01 * sigma * np.linalg.norm(high - low) * shift)
        staging.rename(target)
    return target


def _noisy(found: Any) -> str:
    if isinstance(found, str):
        return found
    facts = found["topology"]
    return (
        f"{found['chamfer']['f1']:.3f}, {found['fidelity']['normal_consistency']:.3f}, "
        f"{facts['euler_number']} ({facts['components']})"
    )


def _panel(found: Any, size: int, shape: Path) -> np.ndarray:
    if isinstance(found, str):
        return panels.empty(size)
    of = "baseline" if found["of"] == "baseline" else "sphere-train"
    return panels.surface(found["run"], of, size, shape=shape)


def resolutions(given: Settings) -> str:
    """The study of the first resolution, with triangles."""
    rows, pictured = [], []
    chosen = given.meshes[: given.noise_shapes]
    for path in chosen:
        line = []
        for n in given.resolutions:

            def measured(path: Path = path, n: int = n) -> dict[str, Any]:
                run = trained(given, path, path.stem, n, "triangle", *TRIANGLE)
                seconds = sum(cpu_seconds(run, stem) for stem in ("init", "sphere-train"))
                return evaluated(given, run, "sphere-train") | {"run": run, "cpu": seconds}

            found = attempt(f"resolutions: {path.stem}, n = {n}", measured)
            line.append(_panel(found, given.panel, path))
            if isinstance(found, str):
                rows.append([path.stem, n, found, *[""] * 6])
                continue
            facts = found["topology"]
            rows.append(
                [path.stem, n, facts["faces"], f"{1e3 * found['chamfer']['cd2']:.4g}",
                 f"{1e3 * found['fidelity']['surface_cd2']:.4g}",
                 f"{found['fidelity']['normal_consistency']:.4f}",
                 "holds" if found["certificate"]["holds"] else "fails",
                 f"{facts['euler_number']}, {facts['components']}", f"{found['cpu']:.0f}"]
            )  # fmt: skip
        pictured.append(line)
    name = "resolutions.png"
    panels.write(
        given.pictures / name,
        panels.grid(pictured, [f"n = {n}" for n in given.resolutions], [p.stem for p in chosen]),
    )
    head = ["shape", "n", "faces", "CD^2 x 1e3", "surface CD^2 x 1e3", "normals", "certificate",
            "Euler number, components", "CPU s"]  # fmt: skip
    return table(head, rows) + f"\n\n![Initial resolutions]({name})"


def inner(given: Settings) -> str:
    """The study of the number of inner cells."""
    path = given.meshes[0]
    rows, pictured = [], []
    for count in given.inner:

        def measured(count: int = count) -> dict[str, Any]:
            first = trained(given, path, path.stem, given.n, "triangle", *TRIANGLE)
            run = given.work / f"{path.stem}-{given.n}-inner{count}.vorolight"
            if not run.exists():
                staging = run.with_suffix(".copying")
                shutil.rmtree(staging, ignore_errors=True)
                shutil.copytree(first, staging, ignore=shutil.ignore_patterns("evaluate-*"))
                staging.rename(run)
            cli("init", path, "-n", given.n, "--run", run)
            cli("sphere-train", *TRIANGLE, *given.flags, "--run", run)
            cli("volume", "--inner", count, "--run", run)
            return metrics(run, "volume") | {"run": run}

        found = attempt(f"inner: {path.stem}, {count}", measured)
        if isinstance(found, str):
            rows.append([count, found, *[""] * 4])
            pictured.append(panels.empty(given.panel))
            continue
        quality = found["quality"]
        rows.append(
            [count, found["cells"], found["changed_faces"], f"{found['volume_error']:.1e}",
             f"{found['surface_to_inner_size']:.3f}", f"{quality['size_ratio']['p95']:.2f}"]
        )  # fmt: skip
        pictured.append(panels.cut(found["run"], given.panel))
    name = "inner.png"
    titles = [f"{count} inner generators" for count in given.inner]
    panels.write(given.pictures / name, panels.grid([pictured], titles, [""]))
    head = ["inner generators", "cells", "faces of the surface changed", "volume less 1",
            "size at the surface / inside", "size of neighbours, P95"]  # fmt: skip
    return table(head, rows) + f"\n\n![{path.stem}, cut open]({name})"


def pipeline(given: Settings) -> str:
    """A slice of the input, the first surface, the trained surface, and the cells."""
    lines, labels = [], []
    for source in ("heart", "cube-cavity", given.meshes[0]):
        label = Path(source).stem
        name = label if isinstance(source, Path) else f"field-{label}"

        def drawn(source: Any = source, name: str = name) -> list[np.ndarray]:
            run = trained(given, source, name, given.n, "polygon", *POLYGON)
            cli("volume", "--inner", given.inner[1], "--run", run)
            return [
                panels.field_slice(run, given.panel),
                panels.surface(run, "init", given.panel),
                panels.surface(run, "sphere-train", given.panel, "trained/"),
                panels.cut(run, given.panel),
            ]

        found = attempt(f"pipeline: {label}", drawn)
        lines.append([panels.empty(given.panel)] * 4 if isinstance(found, str) else found)
        labels.append(label)
    name = "pipeline.png"
    titles = ["slice of the input", "first surface", "trained polygons", "cells, cut open"]
    panels.write(given.pictures / name, panels.grid(lines, titles, labels))
    return f"![Slice, first surface, trained polygons and cells]({name})"
