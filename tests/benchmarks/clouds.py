"""The table of point clouds: meshes are sampled, noise is added, and the samples are run.

Run with ``make table-clouds MESHES=folder PEER=file.json``. Samples have no normals. The result is
compared with the mesh, which the run does not see, in units of the mesh's longest side. Noise is in
percent of the diagonal. PEER has the F1 of another method under ``runs.NAME``, and with 1 % of
noise under ``runs.NAME_n0.01``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from surfaces import cli

from vorolight.stages.inputs.mesh.source import MeshSource

F1_AT = 0.01
"""Threshold of F1, divided by the longest side."""


def row(shape: Path, n: int, count: int, percent: float) -> dict[str, Any]:
    source = MeshSource(shape)
    random = np.random.default_rng(0)
    box = source.bounding_box()
    side, diagonal = float(np.ptp(box, axis=0).max()), float(np.linalg.norm(box[1] - box[0]))
    noise = 0.01 * percent * diagonal
    points = source.surface_samples(count, random)
    points = points + noise * random.standard_normal(points.shape)
    with tempfile.TemporaryDirectory() as folder:
        cloud, run = Path(folder) / "cloud.npy", Path(folder) / "run"
        np.save(cloud, points)
        start = time.perf_counter()
        cli("run", cloud, "-n", n, "--until", "sphere-train", "--run", run)
        seconds = time.perf_counter() - start
        threshold = F1_AT * side / diagonal
        cli("evaluate", "--run", run, "--reference", shape, "--threshold", threshold)
        read = {
            stem: json.loads((run / f"{stem}.json").read_text())["metrics"]
            for stem in ("classify", "evaluate-sphere-train")
        }
    found = read["evaluate-sphere-train"]
    return {
        "f1": found["chamfer"]["f1"],
        "normal_consistency": found["fidelity"]["normal_consistency"],
        "certificate": found["certificate"]["holds"],
        "euler_number": found["topology"]["euler_number"],
        "components": found["topology"]["components"],
        "noise_over_true": read["classify"]["input"]["noise"] / noise if noise else None,
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", type=Path)
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--points", type=int, default=153_600)
    parser.add_argument("--noise", type=float, default=0.0, help="percent of the diagonal")
    parser.add_argument("--peer", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    peers = json.loads(given.peer.read_text())["runs"] if given.peer else {}
    print(f"{given.points} points, noise {given.noise:g} % of the diagonal, n = {given.n}\n"
          "| shape | F1 (peer) | normals | certificate | Euler number, components (peer) "
          "| noise / true | s |\n|---|---|---|---|---|---|---|")  # fmt: skip
    rows = {}
    for shape in given.shapes:
        name = shape.stem
        peer = peers.get(f"{name}_n{given.noise / 100:g}" if given.noise else name, {})
        try:
            found = rows[name] = row(shape, given.n, given.points, given.noise)
        except RuntimeError as fault:
            print(f"| {name} | {fault} |", flush=True)
            continue
        told = found["noise_over_true"]
        cells = [
            name,
            f"{found['f1']:.4f}" + (f" ({peer['f1']:.4f})" if peer else ""),
            f"{found['normal_consistency']:.3f}",
            "holds" if found["certificate"] else "fails",
            f"{found['euler_number']}, {found['components']}"
            + (f" ({peer['euler']}, {peer['components']})" if peer else ""),
            "" if told is None else f"{told:.2f}",
            f"{found['seconds']:.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
    print(f"mean F1 {np.mean([found['f1'] for found in rows.values()]):.4f}")
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
