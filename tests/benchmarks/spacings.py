"""Varied edge lengths beside even ones, with the same number of triangles: ``make table-spacing``.

Both start from the same first surface. Even edges have one value of ``--spacing-min`` and
``--spacing-max``, which is sought so that the number of triangles is that of the varied ones.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from surfaces import cli, metrics

TRIES, NEAR = 4, 0.015


def measured(run: Path) -> dict[str, Any]:
    cli("evaluate", "--run", run)
    found, _ = metrics(run, "evaluate-sphere-train")
    trained, seconds = metrics(run, "sphere-train")
    diagonal = found["protocol"]["diagonal"]
    return {
        "faces": trained["trained_faces"],
        "holds": found["certificate"]["holds"],
        "euler": found["topology"]["euler_number"],
        "cd2": found["fidelity"]["surface_cd2"] * diagonal**2 * 1e3,
        "p99": found["fidelity"]["p99"] * diagonal,
        "seconds": seconds,
    }


def row(shape: str, n: int, faces: int) -> str:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        cli("init", shape, "-n", n, "--run", run)
        cli("sphere-train", "--faces-target", faces, "--run", run)
        varied = measured(run)
        started, _ = metrics(run, "init")
        length = 0.7
        for _ in range(TRIES):
            cli("sphere-train", "--spacing-min", length, "--spacing-max", length, "--run", run)
            count = metrics(run, "sphere-train")[0]["trained_faces"]
            if abs(count / varied["faces"] - 1) < NEAR:
                break
            length = round(length * float(np.sqrt(count / varied["faces"])), 4)
        even = measured(run)
        euler = (started["input_topology"] or {}).get("euler_number", "")
        cells = [Path(shape).stem, f"{varied['faces']}, {even['faces']}"]
        cells += [", ".join("holds" if found["holds"] else "fails" for found in (varied, even))]
        cells += [f"{varied['euler']}, {even['euler']} ({euler})"]
        for key in ("cd2", "p99"):
            ratio = varied[key] / even[key]
            cells.append(f"{varied[key]:.5f}, {even[key]:.5f}: {ratio:.2f}")
        cells.append(f"{varied['seconds']:.0f}, {even['seconds']:.0f}")
        return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", help="mesh files, longest side 1, or built-in fields")
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--faces", type=int, default=4000)
    given = parser.parse_args()
    print("| shape | triangles | certificate | Euler number (input) | surface CD^2 x 1e3 | P99 | "
          "training, s |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for shape in given.shapes:
        try:
            print(row(shape, given.n, given.faces), flush=True)
        except RuntimeError as fault:
            print(f"| {Path(shape).stem} | {fault} |", flush=True)


if __name__ == "__main__":
    main()
