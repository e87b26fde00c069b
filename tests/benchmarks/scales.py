"""The table of units and frames: one mesh unchanged, scaled, far from the origin, and rotated.

Run with ``make table-scales INPUT=bunny.obj``. Figures are divided by the bounding box of the
unchanged mesh, so that they should be the same in every row. Scaling by a power of two must not
change a bit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path

import h5py
import numpy as np
from surfaces import cli

from vorolight.stages.formats import ply
from vorolight.stages.formats.mesh_file import load
from vorolight.stages.mesh.polygons import PolygonMesh


def row(mesh: PolygonMesh, n: int, scale: float, shift: float, turn: np.ndarray) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        path, run = Path(folder) / "mesh.ply", Path(folder) / "run"
        path.write_bytes(ply.encode(mesh.with_vertices(shift + scale * (mesh.vertices @ turn.T))))
        cli("run", path, "-n", n, "--until", "sphere-train", "--run", run)
        # A rotated mesh has another bounding box.
        size = float(np.linalg.norm(np.ptp(load(path).polygons.vertices, axis=0)))
        unit = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) * scale
        cli("evaluate", "--run", run, "--threshold", 0.01 * unit / size)
        found = json.loads((run / "evaluate-sphere-train.json").read_text())["metrics"]
        with h5py.File(run / "sphere-train.h5") as file:
            places = file["surface/vertices"][()] / scale
    stretch = (size / unit) ** 2
    return [
        f"{found['topology']['euler_number']}, {found['topology']['components']}",
        "holds" if found["certificate"]["holds"] else "fails",
        f"{found['chamfer']['cd2'] * stretch:.4e}",
        f"{found['fidelity']['surface_cd2'] * stretch:.2e}",
        f"{found['fidelity']['normal_consistency']:.4f}",
        f"{found['chamfer']['f1']:.4f}",
        f"{found['dihedral_mean_curvature'] * scale:.2f}",
        hashlib.sha256(places.tobytes()).hexdigest()[:8],
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape", type=Path)
    parser.add_argument("-n", type=int, default=25)
    given = parser.parse_args()
    mesh = load(given.shape).polygons
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    print(
        f"n = {given.n}\n| mesh | Euler number, components | certificate | CD^2 "
        "| sample-to-surface CD^2 | normals | F1 | dihedral H | places / scale |\n"
        "|---|---|---|---|---|---|---|---|---|"
    )
    same, still = np.eye(3), 0.0
    for name, scale, shift, turned in (
        ("as it is", 1.0, still, same),
        ("2^-20", 2.0**-20, still, same),
        ("1e-6", 1e-6, still, same),
        ("1e5", 1e5, still, same),
        ("moved by 1000", 1.0, 1000.0, same),
        ("rotated", 1.0, still, turn),
    ):
        print(
            "| " + " | ".join([name, *row(mesh, given.n, scale, shift, turned)]) + " |", flush=True
        )


if __name__ == "__main__":
    main()
