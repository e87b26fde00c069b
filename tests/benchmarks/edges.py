"""Pictures of edges: even ones that follow no crease, ones along creases, and varied lengths.

Run with ``make pictures-edges``. The third has as many triangles as the second. The fourth picture
shows the third coloured by edge length.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import panels
from surfaces import cli, metrics

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.mesh.geometry import fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.render import image_file, raster

SHORT, LONG = np.array([0.80, 0.20, 0.16]), np.array([0.20, 0.42, 0.78])
"""Colours of the shortest and of the longest edges. The scale between them passes through white."""
COLUMNS = ["even, --sharp off", "default", "as many, --faces-target", "edge lengths of the third"]


def lengths(run: Path, size: int) -> np.ndarray:
    """The trained triangles, coloured by their edge lengths on a logarithmic scale."""
    folder = RunFolder(run)
    arrays = folder.arrays("sphere-train", "sphere-train")
    vertices, triangles, faces = fan_triangles(PolygonMesh.from_arrays(arrays, "trained/"))
    spacing = np.log(arrays["spacing"])
    low, high = np.percentile(spacing, [1, 99])
    share = np.clip((spacing - low) / max(high - low, 1e-9), 0, 1)[faces, None]
    white = np.full(3, 0.95)
    color = np.where(
        share < 0.5,
        SHORT + 2 * share * (white - SHORT),
        white + (2 * share - 1) * (LONG - white),
    )
    return raster.shaded(vertices, triangles, faces, color, panels.view(folder, None), size, size)


def row(shape: str, n: int, size: int) -> list[np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        cli("init", shape, "-n", n, "--run", run)
        drawn = []
        cli("sphere-train", "--run", run)
        count = metrics(run, "sphere-train")[0]["trained_faces"]
        after = panels.surface(run, "sphere-train", size)
        even = ["--spacing-min", 0.6, "--spacing-max", 0.6]
        cli("sphere-train", "--sharp", "off", *even, "--run", run)
        drawn += [panels.surface(run, "sphere-train", size), after]
        cli("sphere-train", "--faces-target", count, "--run", run)
        return [*drawn, panels.surface(run, "sphere-train", size), lengths(run, size)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+", help="mesh files or names of built-in fields")
    parser.add_argument("-n", type=int, default=15)
    parser.add_argument("--size", type=int, default=420)
    parser.add_argument("--output", type=Path, default=Path("edges.png"))
    given = parser.parse_args()
    rows = [row(shape, given.n, given.size) for shape in given.shapes]
    page = panels.grid(rows, COLUMNS, [""] * len(rows))
    given.output.write_bytes(image_file.png(page))
    print(given.output)


if __name__ == "__main__":
    main()
