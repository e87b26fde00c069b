"""Eight small shapes, run at once in every way that there is: wall times, and equality of all
files.

Run with ``make concurrency``. Slurm is used if it answers (``sinfo``). Then two processes are
started at once on one run folder: one must work, and the other must end with exit code 75. Exits
with 1 if a file differs.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import ways
from results import write

LOCKED = 75
ON_SLURM = ("vorolight sbatch", "snakemake on Slurm")


def compared(folder: Path, count: int) -> list[dict[str, object]]:
    """A row for each way: its seconds, and the files that differ from those of the first way."""
    reference = ways.prepare(folder / "reference", count)
    rows: list[dict[str, object]] = []
    for name, way in ways.WAYS.items():
        if name in ON_SLURM and not ways.slurm_answers():
            print(f"{name}: not run, no Slurm answers", flush=True)
            continue
        place = reference if not rows else ways.copied(reference, folder / name.replace(" ", "-"))
        began = time.perf_counter()
        way(place)
        seconds = round(time.perf_counter() - began, 1)
        files = sum(len(ways.results(run)) for run in ways.runs(place))
        differing = ways.differences(reference, place) if rows else []
        rows.append({"way": name, "seconds": seconds, "files": files, "differing": differing})
        print(f"{name}: {seconds} s, {files} files, {len(differing)} differ", flush=True)
    return rows


def at_once(folder: Path) -> dict[str, object]:
    """The result of two processes at once on one run folder, whose earlier stages are done."""
    run = "runs/sphere.vorolight"
    command = [sys.executable, "-m", "vorolight.cli"]
    common = ["--run", run, "--threads", "1", "--quiet"]
    train = [*command, "sphere-train", "--iterations", "60", *common]
    alone, both = folder / "alone", folder / "both"
    alone.mkdir()
    ways.call(*command, "init", "sphere", "-n", "8", "--iterations", "5", *common, cwd=alone)
    shutil.copytree(alone, both)
    ways.call(*train, cwd=alone)
    processes = [
        subprocess.Popen(train, cwd=both, stderr=subprocess.PIPE, text=True) for _ in range(2)
    ]
    said = [process.communicate()[1].strip() for process in processes]
    codes = sorted(process.returncode for process in processes)
    return {"codes": codes, "said": max(said), "differing": ways.differences(alone, both)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shapes", type=int, default=8)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = compared(Path(folder), given.shapes)
        pair = at_once(Path(folder))
    print("\n| way | wall time, s | files compared | that differ |\n|---|---|---|---|")
    for row in rows:
        differing = row["differing"]
        assert isinstance(differing, list)
        print(f"| {row['way']} | {row['seconds']} | {row['files']} | {len(differing)} |")
    print(f"two processes on one run folder end with {pair['codes']}: {pair['said']}")
    write("concurrency", {"ways": rows, "at_once": pair})
    faults = [fault for row in [*rows, pair] for fault in row["differing"]]  # type: ignore[attr-defined]
    if pair["codes"] != [0, LOCKED]:
        faults.append(f"exit codes {pair['codes']}, not [0, {LOCKED}]")
    print("\n".join(faults) or "all equal")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
