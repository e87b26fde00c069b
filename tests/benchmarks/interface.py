"""Time of diagram and interface faces by each backend, by scipy.spatial.Voronoi and by Voro++.

Run with ``make bench``. All run in this process in interleaved rounds, so that ratios are
comparable. Voro++ (pyvoro2 on one thread, multivoro on two) is the engine of the paper. It and
scipy.spatial.Voronoi find all faces, from which those between the labels are then selected.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from results import write

from vorolight.stages.voronoi.diagram.delaunay import backend, in_passing
from vorolight.stages.voronoi.diagram.interface import interface


def pairs_on_a_sphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` generators in pairs on both sides of a bumpy sphere, similar to trained ones."""
    random = np.random.default_rng(0)
    direction = random.normal(size=(count // 2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    height = 1 + 0.1 * np.sin(5 * direction[:, :1]) + 0.002 * random.normal(size=(count // 2, 1))
    offset = 1.5 / np.sqrt(count)
    generators = np.concatenate([(height - offset) * direction, (height + offset) * direction])
    return generators, np.arange(count) < count // 2


def by_backend(name: str) -> Callable[[np.ndarray, np.ndarray], int]:
    def run(generators: np.ndarray, inside: np.ndarray) -> int:
        with backend(name) as used:
            count = interface(generators, inside, in_passing(generators)).mesh.face_count
        if used.failures:
            raise SystemExit(used.failures[0])
        return count

    return run


def scipys(generators: np.ndarray, inside: np.ndarray) -> int:
    from scipy.spatial import Voronoi

    diagram = Voronoi(generators)
    mixed = inside[diagram.ridge_points[:, 0]] != inside[diagram.ridge_points[:, 1]]
    return len([diagram.ridge_vertices[i] for i in np.flatnonzero(mixed)])


def voros(generators: np.ndarray, inside: np.ndarray) -> int:
    import pyvoro2

    low, high = generators.min(axis=0) - 1.0, generators.max(axis=0) + 1.0
    box = pyvoro2.Box(tuple(zip(low, high, strict=True)))
    faces = 0
    for cell in pyvoro2.compute(generators, domain=box, output="cells"):
        if inside[cell["id"]]:
            beyond = [face["adjacent_cell"] for face in cell["faces"]]
            faces += sum(1 for other in beyond if not inside[other])
    return faces


def threaded(generators: np.ndarray, inside: np.ndarray) -> int:
    import multivoro

    limits = np.stack([generators.min(axis=0) - 1.0, generators.max(axis=0) + 1.0])
    radii = np.ones(len(generators))
    cells = multivoro.compute_voronoi(generators, limits=limits, radii=radii, n_threads=2)
    faces = 0
    for cell in (cells[i] for i in np.flatnonzero(inside)):
        rings, beyond = cell.get_face_vertices(), np.asarray(cell.get_neighbors())
        faces += len([rings[k] for k in np.flatnonzero(beyond >= 0) if not inside[beyond[k]]])
    return faces


ENGINES = {
    "scipy": by_backend("scipy"),
    "shull": by_backend("shull"),
    "scipy.spatial.Voronoi": scipys,
    "Voro++ (pyvoro2, 1 thread)": voros,
    "Voro++ (multivoro, 2 threads)": threaded,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[5_000, 20_000, 100_000])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    by_backend("shull")(*pairs_on_a_sphere(100))  # starts the child process
    rows = []
    for count in arguments.counts:
        shape = pairs_on_a_sphere(count)
        seconds: dict[str, list[float]] = {name: [] for name in ENGINES}
        faces = {}
        for _ in range(arguments.rounds):
            for name, engine in ENGINES.items():
                start = time.perf_counter()
                faces[name] = engine(*shape)
                seconds[name].append(time.perf_counter() - start)
        # Voro++ drops faces below a tolerance, so that it is not compared.
        if len({faces[name] for name in list(ENGINES)[:3]}) != 1:
            raise SystemExit(f"{count}: the engines disagree on the number of faces: {faces}")
        row: dict[str, Any] = {"generators": count, "faces": faces["scipy"], "seconds": {}}
        row["seconds"] = {name: round(float(np.median(all_)), 3) for name, all_ in seconds.items()}
        for mine in ("scipy", "shull"):
            row[f"speed_of_{mine}_over"] = {
                name: round(row["seconds"][name] / row["seconds"][mine], 2)
                for name in list(ENGINES)[2:]
            }
        rows.append(row)
        print(json.dumps(row), flush=True)
    write("interface", rows)


if __name__ == "__main__":
    main()
