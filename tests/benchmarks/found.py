"""The table of shapes as found: point clouds, and meshes with holes or with double or turned faces.

Run with ``make table-found MESHES="a.obj b.obj"``. Each file is run unchanged. The part of the
input that is visible from outside is compared with the surface, and the surface with the input, in
voxels.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import igl
import numpy as np
from surfaces import cli

from vorolight.stages.formats import ply
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.mesh.geometry import fan_triangles, sample_triangles, triangle_normals

SAMPLES, WITHIN, RAYS, ASIDE = 20_000, 1.5, 200, 1e-3


def visible(source: MeshSource, random: np.random.Generator) -> np.ndarray:
    """Samples of the mesh from which some ray leaves it unhindered, on either side."""
    vertices, triangles = np.ascontiguousarray(source.vertices), source.triangles
    points, face = sample_triangles(vertices, triangles, SAMPLES, random)
    normals = triangle_normals(vertices, triangles)[0][face]
    aside = ASIDE * float(np.ptp(vertices, axis=0).max())
    seen = np.zeros(len(points), dtype=bool)
    for side in (-1, 1):
        start = np.ascontiguousarray(points + side * aside * normals)
        hidden = igl.ambient_occlusion(
            vertices, triangles, start, np.ascontiguousarray(side * normals), RAYS
        )
        seen |= hidden < 1 - 0.5 / RAYS
    return points[seen]


def row(path: Path, n: int, options: list[str]) -> dict[str, Any]:
    random = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        cli("run", path, "-n", n, "--until", "sphere-train", "--run", run, *options)
        stored = {
            stage: json.loads((run / f"{stage}.json").read_text())
            for stage in ("classify", "init", "sphere-train")
        }
        mesh = ply.read(run / "sphere-train.ply")
    assert mesh is not None
    vertices, triangles, _ = fan_triangles(mesh)
    spacing = stored["classify"]["metrics"]["spacing"]
    source: Any = identify(str(path)).open()
    if isinstance(source, MeshSource):
        given = visible(source, random)
    else:
        given = source.surface_samples(SAMPLES, random)
    made = sample_triangles(vertices, triangles, SAMPLES, random)[0]
    far = np.sqrt(igl.point_mesh_squared_distance(given, vertices, triangles)[0])
    back = np.sqrt(igl.point_mesh_squared_distance(made, source.vertices, source.triangles)[0])
    metrics = stored["sphere-train"]["metrics"]
    return {
        "bad_edges": stored["classify"]["metrics"]["input"].get("open_edges"),
        "sureness": stored["classify"]["metrics"]["input"].get("sureness"),
        "input_near": float((far < WITHIN * spacing).mean()),
        "surface_near": float((back < WITHIN * spacing).mean()),
        "closed": metrics["topology"]["bad_edges"] == 0,
        "certificate": metrics["certificate"]["holds"],
        "euler_number": metrics["topology"]["euler_number"],
        "components": metrics["topology"]["components"],
        "seconds": sum(each["volatile"]["wall_seconds"] for each in stored.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", type=Path)
    parser.add_argument("-n", type=int, default=25)
    parser.add_argument("--repair", action="store_true")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    options = ["--repair"] if given.repair else []
    print(
        f"n = {given.n}; near: within {WITHIN} voxels\n"
        "| shape | bad edges | sure | input near the surface | surface near the input | closed "
        "| certificate | Euler number, components | s |\n"
        "|---|---|---|---|---|---|---|---|---|"
    )
    rows = {}
    for shape in given.shapes:
        try:
            found = rows[shape.stem] = row(shape, given.n, options)
        except RuntimeError as fault:
            print(f"| {shape.stem} | {fault} |", flush=True)
            continue
        bad, sure = found["bad_edges"], found["sureness"]
        cells = [
            shape.stem,
            "" if bad is None else str(bad),
            "" if sure is None else f"{100 * sure:.1f} %",
            f"{100 * found['input_near']:.1f} %",
            f"{100 * found['surface_near']:.1f} %",
            "yes" if found["closed"] else "no",
            "holds" if found["certificate"] else "fails",
            f"{found['euler_number']}, {found['components']}",
            f"{found['seconds']:.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
