"""A corpus of shapes whose topology is known, made by exact solids.

``make corpus COUNT=200 N=25`` runs ``vorolight`` on every shape, two at a time on one thread each,
and prints for each whether its surface is certified and has the solid's Euler number and
components, its distance from the solid, CPU seconds and faces. What is done is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SIZE = 10.0
"""Longest side of every shape; a voxel is SIZE / n."""
SEGMENTS = 48
"""Sides of cylinders and balls."""
DRAWS = 100
"""How often a shape is drawn until it is one that can be asked for."""
SAMPLES = 20_000
"""Points on either surface for the distances."""
SPECK = 0.05
"""Parts and cavities of less volume than that of a cube of this many voxels are not asked for."""


@dataclass(frozen=True)
class Known:
    """A closed surface ``vertices (V, 3)``, ``triangles (T, 3)``, and what is known of it."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    euler_number: int
    components: int


def _turn(solid: Any, random: np.random.Generator) -> Any:
    return solid.rotate([float(angle) for angle in 360 * random.random(3)])


def _box(x: float, y: float, z: float) -> Any:
    from manifold3d import Manifold

    return Manifold.cube([x, y, z], True)


def _cylinder(height: float, radius: float) -> Any:
    from manifold3d import Manifold

    return Manifold.cylinder(height, radius, radius, SEGMENTS, True)


def _ball(radius: float) -> Any:
    from manifold3d import Manifold

    return Manifold.sphere(radius, SEGMENTS)


def _torus(ring: float, tube: float) -> Any:
    from manifold3d import CrossSection, Manifold

    return Manifold.revolve(CrossSection.circle(tube, 24).translate([ring, 0]), SEGMENTS)


def _primitive(random: np.random.Generator) -> Any:
    a, b, c = 0.3 + 0.7 * random.random(3)
    solid = (_box(2 * a, 2 * b, 2 * c), _cylinder(2 * a, b), _ball(a), _torus(a, 0.4 * a * b))[
        random.integers(4)
    ]
    return _turn(solid, random).translate([float(v) for v in random.random(3) - 0.5])


def _combined(random: np.random.Generator, voxel: float) -> Any:
    """Two to eight primitives, joined, cut away or intersected."""
    solid = _primitive(random)
    for _ in range(random.integers(1, 8)):
        other, kind = _primitive(random), random.random()
        solid = solid + other if kind < 0.5 else solid - other if kind < 0.85 else solid ^ other
    return solid


def _shell(random: np.random.Generator, voxel: float) -> Any:
    """A hollow box, cylinder or ball with an opening; its wall is 1, 0.3 or 0.1 voxels thick."""
    wall = voxel * (1.0, 0.3, 0.1)[random.integers(3)]
    a, b = (0.4 + 0.6 * random.random(2)) * SIZE / 2
    kind = random.integers(3)
    if kind == 0:
        solid = _box(2 * a, 2 * b, SIZE) - _box(2 * (a - wall), 2 * (b - wall), SIZE - 2 * wall)
    elif kind == 1:
        solid = _cylinder(SIZE, a) - _cylinder(SIZE - 2 * wall, a - wall)
    else:
        solid = _ball(SIZE / 2) - _ball(SIZE / 2 - wall)
    if random.random() < 0.5:
        hole = _cylinder(SIZE, (0.1 + 0.15 * random.random()) * SIZE).translate([0, 0, SIZE / 2])
        solid = solid - hole
    return _turn(solid, random)


def _slit(random: np.random.Generator, voxel: float) -> Any:
    """A block with slits of half a voxel down to a tenth of one."""
    a, b = (0.4 + 0.6 * random.random(2)) * SIZE
    solid = _box(a, b, SIZE)
    for _ in range(random.integers(1, 4)):
        wide = voxel * (0.5, 0.3, 0.1)[random.integers(3)]
        deep = (0.2 + 0.5 * random.random()) * a
        at = 0.8 * SIZE * (random.random() - 0.5)
        solid = solid - _box(deep, 2 * b, wide).translate([0.5 * a, 0, float(at)])
    return _turn(solid, random)


def _holes(random: np.random.Generator, voxel: float) -> Any:
    """A plate with holes of half a voxel to two voxels."""
    solid = _box(SIZE, SIZE * (0.4 + 0.6 * random.random()), voxel * (1 + 4 * random.random()))
    for _ in range(random.integers(1, 6)):
        wide = voxel * (0.25, 0.5, 1.0)[random.integers(3)]
        x, y = 0.35 * SIZE * (2 * random.random(2) - 1) * [1, 0.4]
        solid = solid - _cylinder(SIZE, wide).translate([float(x), float(y), 0])
    return _turn(solid, random)


def _needle(random: np.random.Generator, voxel: float) -> Any:
    """A ball or box with needles, from a voxel to a fifth of one wide."""
    from manifold3d import Manifold

    solid = _ball(0.25 * SIZE) if random.random() < 0.5 else _box(*(0.4 * SIZE,) * 3)
    for _ in range(random.integers(1, 5)):
        wide = voxel * (1.0, 0.5, 0.2)[random.integers(3)]
        tip = wide * (1.0, 0.3)[random.integers(2)]
        needle = Manifold.cylinder(SIZE / 2, wide / 2, tip / 2, 24)
        solid = solid + _turn(needle, random)
    return solid


def _plate(random: np.random.Generator, voxel: float) -> Any:
    """A plate as thin as a 50th, a 100th or a 200th of its side."""
    thin = SIZE / (50, 100, 200)[random.integers(3)]
    wide = SIZE * (0.15 + 0.35 * random.random())
    return _turn(_box(SIZE, wide, thin), random)


def _nested(random: np.random.Generator, voxel: float) -> Any:
    """A solid with cavities in each other."""
    solid = _turn(_box(*(SIZE / 1.8,) * 3), random) if random.random() < 0.5 else _ball(SIZE / 2)
    for k in range(random.integers(1, 5)):
        size = SIZE / 2 * (0.5 - 0.1 * k + 0.03 * random.random())
        inner = _turn(_box(*(1.1 * size,) * 3), random) if random.random() < 0.5 else _ball(size)
        solid = solid - inner if k % 2 == 0 else solid + inner
    return solid


def _bodies(random: np.random.Generator, voxel: float) -> Any:
    """Two to six bodies in a row, close to each other."""
    from manifold3d import Manifold

    parts, at = [], 0.0
    for _ in range(random.integers(2, 7)):
        part = _turn(_primitive(random).scale([1.0 + random.random()] * 3), random)
        low = part.bounding_box()[0]
        parts.append(part.translate([at - low, 0, 0]))
        at = parts[-1].bounding_box()[3] + (0.02 + 0.2 * random.random())
    return Manifold.compose(parts)


KINDS: tuple[Callable[[np.random.Generator, float], Any], ...] = (
    _combined, _shell, _combined, _slit, _combined, _holes, _combined, _needle, _combined, _plate,
    _combined, _nested, _combined, _bodies,
)  # fmt: skip


def shape(index: int, n: int) -> Known:
    """Shape ``index`` of the corpus, with thin parts measured in the voxels of ``n``."""
    kind = KINDS[index % len(KINDS)]
    voxel = SIZE / n
    for draw in range(DRAWS):
        # The same shape at every n, but for what is measured in voxels.
        random = np.random.default_rng([index, draw])
        solid = kind(random, voxel)
        if solid.is_empty():
            continue
        box = np.array(solid.bounding_box())
        solid = solid.scale([SIZE / float((box[3:] - box[:3]).max())] * 3)
        parts = solid.decompose()
        if min(abs(part.volume()) for part in parts) > (SPECK * voxel) ** 3:
            return _known(f"{index:04d}{kind.__name__}", solid)
    raise RuntimeError(f"shape {index}: {DRAWS} draws gave none")


def _known(name: str, solid: Any) -> Known:
    from vorolight.stages.mesh.polygons import PolygonMesh
    from vorolight.stages.mesh.topology import topology

    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties)[:, :3]
    triangles = np.asarray(mesh.tri_verts).astype(np.int64)
    facts = topology(PolygonMesh.of_triangles(vertices, triangles))
    return Known(
        name, vertices, triangles, facts.euler_number + facts.pinched_vertices, facts.components
    )


def run(known: Known, n: int, folder: Path, options: list[str]) -> dict[str, Any]:
    """What a run of ``vorolight`` on the shape ended with, from its files where it is done."""
    stem = folder / known.name
    done = stem.with_suffix(".row")
    if done.is_file():
        return json.loads(done.read_text())
    write(known, stem.with_suffix(".ply"))
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "vorolight.cli", "run", f"{stem}.ply", "--quiet"]
    command += ["-n", str(n), "--threads", "1", "--until", "sphere-train", *options]
    command += ["--run", f"{stem}.vorolight"]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    row: dict[str, Any] = {"name": known.name, "exit": ended.returncode, "expected":
                           [known.euler_number, known.components]}  # fmt: skip
    if ended.returncode == 0:
        row |= judged(known, Path(f"{stem}.vorolight"))
    else:
        row["said"] = ended.stderr.strip().splitlines()[-1][:300]
    done.write_text(json.dumps(row))
    return row


def write(known: Known, path: Path) -> None:
    from vorolight.stages.formats import ply
    from vorolight.stages.mesh.polygons import PolygonMesh

    path.write_bytes(ply.encode(PolygonMesh.of_triangles(known.vertices, known.triangles)))


def judged(known: Known, folder: Path) -> dict[str, Any]:
    """Certificate, topology of the written file as read by trimesh, distances, time."""
    import igl
    import trimesh

    manifests = {stage: json.loads((folder / f"{stage}.json").read_text())
                 for stage in ("classify", "init", "sphere-train")}  # fmt: skip
    found = manifests["sphere-train"]["metrics"]
    # As in the file: what is merged there is merged by whoever reads it.
    written = trimesh.load_mesh(folder / "sphere-train.ply", process=False)
    shells = len(written.split(only_watertight=False, repair=False))
    squares = []
    for points, mesh in (
        (written.sample(SAMPLES, seed=0), (known.vertices, known.triangles)),
        (
            trimesh.Trimesh(known.vertices, known.triangles, process=False).sample(SAMPLES, seed=0),
            (np.asarray(written.vertices), np.asarray(written.faces)),
        ),
    ):
        squares.append(igl.point_mesh_squared_distance(np.asarray(points), *mesh)[0].mean())
    return {
        "certified": found["certificate"]["holds"],
        "topology": [int(written.euler_number), shells],
        "watertight": bool(written.is_watertight and written.is_winding_consistent),
        "cd2": float(sum(squares)) / SIZE**2,
        "cpu": sum(m["volatile"]["cpu_seconds"] for m in manifests.values()),
        "faces": found["trained_faces"],
    }


def right(row: dict[str, Any]) -> bool:
    """Certified, closed, and of the solid's Euler number and components."""
    return bool(row.get("certified") and row["watertight"] and row["topology"] == row["expected"])


def line(row: dict[str, Any]) -> str:
    if row["exit"]:
        return f"| {row['name']} | no: {row['said']} | | | | |"
    topology = f"{row['topology']}" + (
        "" if row["topology"] == row["expected"] else f" for {row['expected']}"
    )
    return (
        f"| {row['name']} | {'yes' if row['certified'] else 'no'} | {topology} | "
        f"{1e3 * row['cd2']:.6f} | {row['cpu']:.0f} | {row['faces']} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--folder", type=Path, default=Path("corpus"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("options", nargs="*", help="for vorolight run, after --")
    given = parser.parse_args()
    folder = given.folder / f"n{given.n}"
    folder.mkdir(parents=True, exist_ok=True)
    print("| shape | certified | Euler number, components | CD^2 x 1e3, longest side 1 | CPU s | "
          "faces |\n|---|---|---|---|---|---|")  # fmt: skip
    rows = []
    with ThreadPoolExecutor(given.jobs) as pool:
        for row in pool.map(
            lambda index: run(shape(index, given.n), given.n, folder, given.options),
            range(given.first, given.first + given.count),
        ):
            print(line(row), flush=True)
            rows.append(row)
    fine = [row for row in rows if right(row)]
    print(f"\n{len(fine)} of {len(rows)} certified with the known Euler number and components")
    if fine:
        cpu, faces = (np.array([row[key] for row in fine], float) for key in ("cpu", "faces"))
        each = cpu / faces
        print(
            f"median {np.median(cpu):.0f} CPU s, {np.median(faces):.0f} faces, "
            f"{1e3 * np.median(each):.2f} ms a face, most {each.max() / np.median(each):.1f} times "
            f"that; median CD^2 x 1e3 {1e3 * np.median([row['cd2'] for row in fine]):.6f}"
        )
    sys.exit(len(fine) < len(rows))


if __name__ == "__main__":
    main()
