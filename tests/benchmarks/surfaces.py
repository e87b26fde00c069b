"""The table of surfaces: certificate, topology, distances and smoothness of each shape.

Run with ``make table MESHES=folder PEER=file.json``. The longest side of each mesh must be 1. PEER
has the results of another method under ``runs.NAME``: ``surface_polygons``, ``surface_cd2_x1e3``,
``normal_consistency``, ``dihedral_H``, ``dihedral_H_truth``. There are at most as many faces as the
other method has.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

TRIES, BELOW = 4, 0.98
"""Largest number of trainings until a shape has no more faces than the other method, and the share
of those that is asked for."""
MERGED = 0.55
"""Expected number of faces with polygons, divided by the number of triangles that are merged."""


def cli(*words: object) -> None:
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, words))}: {done.stderr.strip()[-300:]}")


def metrics(run: Path, stem: str) -> tuple[dict[str, Any], float]:
    manifest = json.loads((run / f"{stem}.json").read_text())
    return manifest["metrics"], manifest["volatile"]["wall_seconds"]


def row(shape: str, n: int, faces: str, most: int | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        cli("init", shape, "-n", n, "--run", run)
        target = BELOW * (most or 0) / (MERGED if faces == "polygon" else 1)
        for _ in range(TRIES):
            options = [] if most is None else ["--faces-target", round(target)]
            cli("sphere-train", "--faces", faces, *options, "--run", run)
            trained, seconds = metrics(run, "sphere-train")
            if most is None or trained["trained_faces"] <= most:
                break
            target *= BELOW * most / trained["trained_faces"]
        cli("evaluate", "--run", run)
        found, _ = metrics(run, "evaluate-sphere-train")
        started, first = metrics(run, "init")
        expected = started["input_topology"]
        topology = found["topology"]
        return {
            "certificate": found["certificate"]["holds"],
            "failed": found["certificate"]["failed"],
            "pair_area_share": found["conformity"]["pair_area_share"],
            "trained_faces": trained["trained_faces"],
            "polygon_share": trained.get("polygons", {}).get("share", 0.0),
            "creases": trained.get("creases"),
            "edge_f1": (found["creases"] or {}).get("edge_f1"),
            "surface_p99": found["fidelity"]["p99"] * found["protocol"]["diagonal"],
            "surface_cd2_x1e3": found["fidelity"]["surface_cd2"]
            * found["protocol"]["diagonal"] ** 2
            * 1e3,
            "normal_consistency": found["fidelity"]["normal_consistency"],
            "dihedral_H": found["dihedral_mean_curvature"],
            "dihedral_H_truth": found["reference_dihedral"],
            "mean_H": found["curvature"] and found["curvature"]["mean"],
            "p95_H": found["curvature"] and found["curvature"]["p95"],
            "mean_H_truth": found["reference_curvature"] and found["reference_curvature"]["mean"],
            "mean_F": found["sdf_loss"],
            "topology": [topology["euler_number"], topology["components"]],
            "input_topology": expected and [expected["euler_number"], expected["components"]],
            "init_seconds": first,
            "train_seconds": seconds,
        }


def show(name: str, found: dict[str, Any], peer: dict[str, Any]) -> None:
    def pair(key: str, form: str) -> str:
        text = form.format(found[key])
        return text + (f" ({form.format(peer[key])})" if key in peer else "")

    truth = found["dihedral_H_truth"] or float("nan")
    right = found["input_topology"] in (None, found["topology"])
    cells = [
        name,
        "holds" if found["certificate"] else "fails: " + " ".join(found["failed"]),
        f"{found['pair_area_share']:.6f}",
        f"{found['trained_faces']} ({peer.get('surface_polygons', '')})",
        f"{found['polygon_share']:.2f}",
        pair("surface_cd2_x1e3", "{:.5f}"),
        pair("surface_p99", "{:.5f}"),
        "" if found["edge_f1"] is None else f"{found['edge_f1']:.3f}",
        pair("normal_consistency", "{:.3f}"),
        f"{found['dihedral_H']:.2f} / {truth:.2f}",
        f"{found['topology']}" + ("" if right else f" for {found['input_topology']}"),
        f"{found['init_seconds']:.1f} + {found['train_seconds']:.1f}",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)
    if found["mean_F"] is not None:
        print(f"    {name}: mean |F| {found['mean_F']:.6f}, mean |H| {found['mean_H']:.3f} "
              f"({found['mean_H_truth']:.3f}), P95 {found['p95_H']:.3f}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", help="mesh files or names of built-in fields")
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--faces", default="triangle")
    parser.add_argument("--peer", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    peers = json.loads(given.peer.read_text())["runs"] if given.peer else {}
    print("| shape | certificate | pair area | faces (peer) | in polygons | surface CD^2 x 1e3 "
          "(peer) | P99 (peer) | edge F1 | normals (peer) | dihedral H / truth | "
          "topology | init + train, s |\n"
          "|---|---|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    rows = {}
    for shape in given.shapes:
        name = Path(shape).stem
        peer = peers.get(name, {})
        try:
            rows[name] = row(shape, given.n, given.faces, peer.get("surface_polygons"))
        except RuntimeError as fault:
            print(f"| {name} | {fault} |", flush=True)
            continue
        show(name, rows[name], peer)
    for key in ("surface_cd2_x1e3", "normal_consistency"):
        values = [found[key] for found in rows.values()]
        print(f"median {key} {np.median(values):.5f}, mean {np.mean(values):.5f}")
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
