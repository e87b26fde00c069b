"""The table of views: meshes are rendered, the pictures are run, and the results compared.

Run with ``make table-views MESHES=folder COUNT=6``. CD^2 and F1 at 0.01 come from 50,000 samples of
each surface, with bounding-box diagonal 1. The sampling floor is the value for two samplings of one
surface.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from surfaces import cli


def row(shape: Path, given: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        views, run = Path(folder) / shape.stem, Path(folder) / "run"
        cli("views", shape, "-o", views, "--count", given.count, "--size", given.size)
        if given.masks_only:
            transforms = json.loads((views / "transforms.json").read_text())
            for frame in transforms["frames"]:
                del frame["normal_file_path"]
            (views / "transforms.json").write_text(json.dumps(transforms))
        start = time.perf_counter()
        cli("run", views, "-n", given.n, "--until", "sphere-train", "--run", run)
        seconds = time.perf_counter() - start
        cli("evaluate", "--run", run, "--reference", shape)
        read = {
            stem: json.loads((run / f"{stem}.json").read_text())["metrics"]
            for stem in ("classify", "evaluate-sphere-train")
        }
        if given.keep:
            given.keep.mkdir(parents=True, exist_ok=True)
            kept = given.keep / f"{shape.stem}-{given.count}.ply"
            shutil.copy(run / "sphere-train.ply", kept)
    found = read["evaluate-sphere-train"]
    return {
        "cd2": 1e3 * found["chamfer"]["cd2"],
        "floor": 1e3 * found["chamfer"]["sampling_floor"],
        "f1": found["chamfer"]["f1"],
        "normal_consistency": found["fidelity"]["normal_consistency"],
        "certificate": found["certificate"]["holds"],
        "euler_number": found["topology"]["euler_number"],
        "components": found["topology"]["components"],
        "overlap": read["classify"]["input"]["mask_overlap_mean"],
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", type=Path)
    parser.add_argument("-n", type=int, default=40)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--masks-only", action="store_true")
    parser.add_argument("--keep", type=Path, help="a folder for the surfaces")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    masks = ", masks only" if given.masks_only else ""
    print(f"{given.count} views of {given.size} x {given.size}{masks}, n = {given.n}\n"
          "| shape | CD^2 x 1e3 (floor) | F1 | normals | certificate | Euler number, components "
          "| mask overlap | s |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    rows = {}
    for shape in given.shapes:
        try:
            found = rows[shape.stem] = row(shape, given)
        except RuntimeError as fault:
            print(f"| {shape.stem} | {fault} |", flush=True)
            continue
        cells = [
            shape.stem,
            f"{found['cd2']:.4f} ({found['floor']:.4f})",
            f"{found['f1']:.4f}",
            f"{found['normal_consistency']:.3f}",
            "holds" if found["certificate"] else "fails",
            f"{found['euler_number']}, {found['components']}",
            f"{found['overlap']:.3f}",
            f"{found['seconds']:.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
    for key in ("cd2", "f1", "overlap", "seconds"):
        print(f"mean {key} {np.mean([found[key] for found in rows.values()]):.4f}")
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
