"""Diagram and interface faces, against scipy.spatial.Voronoi and a selection of its ridges.

Run with ``make bench``. Both ways run in turn in this process; the ratio is what counts.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vorolight.stages.voronoi.interface import interface

RESULTS = Path(__file__).parent / "results" / "interface.json"


def pairs_on_a_sphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` generators in pairs on either side of a bumpy sphere, as training leaves them."""
    random = np.random.default_rng(0)
    direction = random.normal(size=(count // 2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    height = 1 + 0.1 * np.sin(5 * direction[:, :1]) + 0.002 * random.normal(size=(count // 2, 1))
    offset = 1.5 / np.sqrt(count)
    generators = np.concatenate([(height - offset) * direction, (height + offset) * direction])
    return generators, np.arange(count) < count // 2


def ours(generators: np.ndarray, inside: np.ndarray) -> int:
    return interface(generators, inside).mesh.face_count


def scipys(generators: np.ndarray, inside: np.ndarray) -> int:
    from scipy.spatial import Voronoi

    diagram = Voronoi(generators)
    mixed = inside[diagram.ridge_points[:, 0]] != inside[diagram.ridge_points[:, 1]]
    return len([diagram.ridge_vertices[i] for i in np.flatnonzero(mixed)])


def seconds(run: Callable[..., int], *arguments: np.ndarray) -> tuple[float, int]:
    start = time.perf_counter()
    found = run(*arguments)
    return time.perf_counter() - start, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[5_000, 20_000, 100_000])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    rows = []
    for count in arguments.counts:
        shape = pairs_on_a_sphere(count)
        timed = [(seconds(ours, *shape), seconds(scipys, *shape)) for _ in range(arguments.rounds)]
        faces = {found for both in timed for _, found in both}
        if len(faces) != 1:
            raise SystemExit(f"{count}: the two disagree on the number of faces: {faces}")
        ratio = float(np.median([theirs[0] / mine[0] for mine, theirs in timed]))
        rows.append(
            {
                "generators": count,
                "faces": faces.pop(),
                "ours_s": min(mine[0] for mine, _ in timed),
                "scipy_voronoi_s": min(theirs[0] for _, theirs in timed),
                "speed_over_scipy_voronoi": ratio,
            }
        )
        print(json.dumps(rows[-1]))
    machine = {"machine": platform.machine(), "python": platform.python_version()}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"machine": machine, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
