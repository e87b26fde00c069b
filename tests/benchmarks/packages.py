"""The built wheel in new environments of several versions of Python: ``make packages``.

It must install with the pinned versions, pass ``doctor``, run, and give the same results.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

RUN = ["run", "sphere", "-n", "6", "--until", "volume", "--inner", "20", "--threads", "1", "-q"]
STAGES = ("classify", "init", "sphere-train", "volume")
HEADER = ("python", "installed in s", "doctor", "ran in s", "faces", "Euler", "cells", "results")
SECONDS = 1800


def timed(*words: object, cwd: Path, code: int = 0) -> tuple[str, float]:
    """The output of a command, and its seconds. Ends the program if the command fails."""
    began = time.perf_counter()
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, capture_output=True, text=True, timeout=SECONDS
    )
    if done.returncode != code:
        sys.exit(f"{' '.join(map(str, words))}: ended with {done.returncode}\n{done.stderr}")
    return done.stdout, time.perf_counter() - began


def tried(python: str, wheel: Path, constraints: Path) -> dict[str, Any]:
    """The results of the wheel in a new environment of ``python``, which is removed afterwards."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        version = timed(python, "-c", "import platform; print(platform.python_version())",
                        cwd=place)[0].strip()  # fmt: skip
        timed(python, "-m", "venv", place / "env", cwd=place)
        pip = [place / "env" / "bin" / "python", "-m", "pip", "install", "--quiet"]
        _, installed = timed(*pip, "--only-binary", ":all:", "-c", constraints, wheel, cwd=place)
        command = place / "env" / "bin" / "vorolight"
        told = timed(command, "doctor", "--json", cwd=place)[0].splitlines()
        _, ran = timed(command, *RUN, cwd=place)
        run = place / "sphere.vorolight"
        manifests = [json.loads((run / f"{stage}.json").read_text()) for stage in STAGES]
        return {
            "version": version,
            "installed": installed,
            "notes": [one["name"] for one in map(json.loads, told) if one["verdict"] != "ok"],
            "ran": ran,
            "topology": manifests[2]["metrics"]["topology"],
            "cells": manifests[3]["metrics"]["cells"],
            "sums": [out["sha256"] for made in manifests for out in made["outputs"]],
        }


def row(found: dict[str, Any], first: dict[str, Any]) -> tuple[str, ...]:
    same = found["sums"] == first["sums"]
    return (
        found["version"],
        f"{found['installed']:.0f}",
        f"no problem, notes: {', '.join(found['notes']) or 'none'}",
        f"{found['ran']:.1f}",
        str(found["topology"]["faces"]),
        str(found["topology"]["euler_number"]),
        str(found["cells"]),
        "the first" if found is first else "the same bytes" if same else "other bytes",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pythons", nargs="+", help="interpreters; those not found are left out")
    parser.add_argument("--wheel", type=Path, required=True)
    parser.add_argument("--constraints", type=Path, default=Path("constraints.txt"))
    given = parser.parse_args()
    found = []
    for name in given.pythons:
        python = shutil.which(name)
        if python is None or subprocess.run([python, "-V"], capture_output=True).returncode:
            print(f"{name}: not found, left out", file=sys.stderr)
            continue
        print(f"{name}: ...", file=sys.stderr)
        found.append(tried(python, given.wheel.resolve(), given.constraints.resolve()))
    if not found:
        sys.exit("none of the Pythons is there; name some with PYTHONS")
    rows = [HEADER, tuple("---" for _ in HEADER), *(row(one, found[0]) for one in found)]
    print("\n".join(f"| {' | '.join(cells)} |" for cells in rows))
    for one in found:
        if (one["topology"], one["cells"]) != (found[0]["topology"], found[0]["cells"]):
            sys.exit(f"Python {one['version']} makes another surface or other cells")


if __name__ == "__main__":
    main()
