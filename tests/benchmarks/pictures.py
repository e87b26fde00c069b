"""Pictures of shapes side by side: the first surface, the paper's training, triangles, polygons.

Run with ``make side-by-side MESHES="bunny.obj heart" OUTPUT=folder``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.render import image_file
from vorolight.stages.report import pictures

WAYS = {
    "paper": ["--preset", "paper", "--faces", "polygon"],
    "triangle": ["--faces", "triangle"],
    "polygon": ["--faces", "polygon"],
}


def cli(*words: object) -> None:
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr.strip()[-300:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", help="mesh files or names of built-in fields")
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--output", type=Path, default=Path())
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    for shape in given.shapes:
        panels = []
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            cli("init", shape, "-n", given.n, "--run", run)
            for options in WAYS.values():
                cli("sphere-train", *options, "--run", run)
                # Three panels: the first surface, the trained one, and the written one.
                drawn = pictures.surfaces(RunFolder(run))
                assert drawn is not None
                first, _, written = np.array_split(drawn, 3, axis=1)
                panels += [written] if panels else [first, written]
        target = given.output / f"{Path(shape).stem}-{given.n}.png"
        target.write_bytes(image_file.png(np.concatenate(panels, axis=1)))
        print(target, flush=True)


if __name__ == "__main__":
    main()
