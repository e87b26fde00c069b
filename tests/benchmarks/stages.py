"""Time and peak memory of each stage at growing resolutions, and the exponents of the growth.

Run with ``make bench-stages INPUT=bunny.obj RESOLUTIONS="25 50 100"``. Each stage is a process. Its
time and memory for a sphere of a few voxels are those of start-up and imports. They are subtracted
before exponents are fitted to the number of trained faces.
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
from results import write

START_UP = "sphere", 5


def stage(run: Path, name: str, *words: object) -> dict[str, Any]:
    command = [sys.executable, "-m", "vorolight.cli", name, *map(str, words), "--quiet"]
    done = subprocess.run([*command, "--run", str(run)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr.strip()[-300:]}")
    record = json.loads((run / f"{name}.json").read_text())
    volatile = record["volatile"]
    return {
        "seconds": volatile["wall_seconds"],
        "cpu_seconds": volatile["cpu_seconds"],
        "peak_memory_mb": volatile["peak_memory_mb"],
        "metrics": record["metrics"],
    }


def measured(shape: str, n: int, faces: str, backend: str) -> dict[str, Any]:
    more = ["--backend", backend]
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        found = {
            "classify": stage(run, "classify", shape, "-n", n, *more),
            "init": stage(run, "init", *more),
            "sphere-train": stage(run, "sphere-train", "--faces", faces, *more),
        }
    trained = found["sphere-train"]["metrics"]
    row = {
        "n": n,
        "generators": found["init"]["metrics"]["generators"],
        "faces": trained["trained_faces"],
        "certificate": trained["certificate"]["holds"],
        "repair_rounds": trained["repair_rounds"],
        "stages": {
            name: {key: value for key, value in entry.items() if key != "metrics"}
            for name, entry in found.items()
        },
    }
    row["seconds"] = round(sum(entry["seconds"] for entry in row["stages"].values()), 1)
    row["microseconds_a_face"] = round(
        1e6 * row["stages"]["sphere-train"]["seconds"] / row["faces"], 1
    )
    return row


def exponents(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Slopes of log time and log memory over log faces, with the smallest row subtracted."""
    base, rest = rows[0], rows[1:]
    faces = np.log([row["faces"] for row in rest])
    found: dict[str, dict[str, float]] = {}
    for key in ("seconds", "peak_memory_mb"):
        found[key] = {}
        for name in base["stages"]:
            values = [row["stages"][name][key] - base["stages"][name][key] for row in rest]
            if min(values) > 0:
                found[key][name] = round(float(np.polyfit(faces, np.log(values), 1)[0]), 3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape")
    parser.add_argument("-n", type=int, nargs="+", default=[25, 50])
    parser.add_argument("--faces", default="triangle")
    parser.add_argument("--backend", default="scipy")
    given = parser.parse_args()
    rows = []
    for shape, n in [START_UP, *((given.shape, n) for n in given.n)]:
        rows.append(measured(shape, n, given.faces, given.backend))
        print(json.dumps(rows[-1]), flush=True)
    result = {"rows": rows, "exponents": exponents(rows) if len(given.n) > 1 else None}
    print(json.dumps(result["exponents"]))
    write(f"stages-{Path(given.shape).stem}-{given.faces}-{given.backend}", result)


if __name__ == "__main__":
    main()
