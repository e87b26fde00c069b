"""The table of the baseline: ``vorolight baseline`` beside the code of VoroMesh's authors.

Run with ``make table-baseline MESHES=folder PEER=file.json``. The longest side of each mesh must be
1. PEER has the results of that code under ``runs.NAME``: ``surface_polygons``,
``surface_cd2_x1e3``, ``normal_consistency``, ``euler``, ``generators``.

Where a shape has tips thinner than a grid box (homer's fingers, cheburashka's thumbs), the seed
decides which of them are lost. The surface CD^2 of two seeds can then differ by a factor of five.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from surfaces import cli, metrics


def row(shape: str, method: str, seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        before = os.times()
        cli("baseline", method, shape, "--seed", seed, "--run", run)
        after = os.times()
        cli("evaluate", "--of", "baseline", "--run", run)
        made, wall = metrics(run, "baseline")
        found, _ = metrics(run, "evaluate-baseline")
        return {
            "surface_cd2_x1e3": found["fidelity"]["surface_cd2"]
            * found["protocol"]["diagonal"] ** 2
            * 1e3,
            "normal_consistency": found["fidelity"]["normal_consistency"],
            "surface_polygons": found["topology"]["faces"],
            "euler": found["topology"]["euler_number"],
            "components": found["topology"]["components"],
            "bad_edges": found["topology"]["bad_edges"],
            "pinched_vertices": found["topology"]["pinched_vertices"],
            "input_topology": made["input_topology"],
            "generators": made["generators"],
            # The time of the whole command, with its start and classify.
            "cpu_seconds": after.children_user
            + after.children_system
            - before.children_user
            - before.children_system,
            "wall_seconds": wall,
        }


def show(name: str, found: dict[str, Any], peer: dict[str, Any]) -> None:
    def pair(key: str, form: str) -> str:
        text = form.format(found[key])
        return text + (f" ({form.format(peer[key])})" if peer.get(key) is not None else "")

    ratio = found["surface_cd2_x1e3"] / peer["surface_cd2_x1e3"] if peer else float("nan")
    cells = [
        name,
        pair("surface_cd2_x1e3", "{:.6f}"),
        f"{ratio:.3f}",
        pair("normal_consistency", "{:.4f}"),
        pair("surface_polygons", "{}"),
        pair("generators", "{}"),
        pair("euler", "{}"),
        f"{found['bad_edges']}, {found['pinched_vertices']}",
        f"{found['cpu_seconds']:.1f}",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", help="mesh files")
    parser.add_argument("--method", default="voromesh")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--peer", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    peers = json.loads(given.peer.read_text())["runs"] if given.peer else {}
    print("| shape | surface CD^2 x 1e3 (peer) | ratio | normals (peer) | polygons (peer) | "
          "generators (peer) | Euler (peer) | bad edges, pinched | CPU s |\n"
          "|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    rows = {}
    for shape in given.shapes:
        name = Path(shape).stem
        try:
            rows[name] = row(shape, given.method, given.seed)
        except RuntimeError as fault:
            print(f"| {name} | {fault} |", flush=True)
            continue
        show(name, rows[name], peers.get(name, {}))
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
