"""What the report draws and writes, without a browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli, sphere_mesh

from vorolight.stages.artifacts.hdf5 import read
from vorolight.stages.mesh.topology import topology
from vorolight.stages.report import comparison, simplify, surfaces, tables


def test_residuals_are_those_of_the_training(
    heart_run: Path, manifest: Callable[[str], dict[str, Any]]
) -> None:
    arrays = read(heart_run / "sphere-train.h5", "sphere-train")[0]
    found = surfaces.residuals(arrays, float(manifest("classify")["metrics"]["spacing"]))
    valences = np.diff(arrays["trained/face_offsets"])
    whole = np.sqrt((found**2 * valences).sum() / valences.sum())
    recorded = manifest("sphere-train")["metrics"]["conformity"]["residual_rms"]
    # Of a certified surface both are rounding.
    assert whole == pytest.approx(recorded, rel=1e-3, abs=1e-10)


def test_voxels_are_bounded_by_squares() -> None:
    interior = np.zeros((3, 4, 5), dtype=bool)
    interior[1, 1:3, 1:4] = True
    mesh = simplify.voxel_surface(interior)
    facts = topology(mesh)
    assert facts.closed
    assert (facts.faces, facts.euler_number) == (2 * (2 * 3 + 2 + 3), 2)
    assert mesh.vertices.min(axis=0).tolist() == [1, 1, 1]
    assert mesh.vertices.max(axis=0).tolist() == [2, 3, 4]


def test_large_surfaces_are_drawn_with_fewer_triangles(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, triangles = sphere_mesh(level=4)
    monkeypatch.setattr(simplify, "TRIANGLES", 1000)
    for fewer in (simplify.simplified(vertices, triangles, 1e-4),
                  simplify.clustered(vertices, triangles)):  # fmt: skip
        assert 300 < len(fewer[1]) <= 1000
        assert np.abs(np.linalg.norm(fewer[0], axis=1) - 1).max() < 0.05


def test_numbers_are_written_to_be_read() -> None:
    assert tables.number(12345) == "12,345"
    assert tables.number(10.0, 1) == "10"
    assert tables.number(-0.5) == "−0.5"
    assert tables.number(1.5e-7) == "1.5·10⁻⁷"
    assert tables.shown([1] * 9) == "9 entries"
    assert tables.shown(None, "default") == "default"
    assert comparison.best([1.0, 0.5, None], 0.0) == [False, True, False]
    assert comparison.best([1.0, 1.0], 0.0) == [False, False]


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (["RUN"], 2, "two or more run folders"),
        (["RUN", "RUN"], 2, "given twice"),
        (["RUN", "nowhere"], 4, "no such run folder"),
        (["RUN", "."], 4, "no stage is done"),
        (["RUN", ".", "-o", "no/such/page.html"], 2, "another file with -o"),
    ],
    ids=["one", "twice", "nowhere", "no run", "no folder"],
)
def test_what_cannot_be_compared(
    words: list[str], code: int, reason: str, heart_run: Path, tmp_path: Path, cli: Cli
) -> None:
    said = [str(heart_run) if word == "RUN" else word for word in words]
    done = cli("compare", *said, cwd=tmp_path)
    assert (done.returncode, reason in done.stderr) == (code, True), done.stderr
    assert done.stderr.count("\n") == 1
