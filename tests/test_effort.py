"""What a run will take is told by stage classify, and refused there where it is too much."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh
from conftest import Cli, write_ply

from vorolight.stages.run import run


def plate(folder: Path, thin: float) -> Path:
    """A plate of 10 by 10."""
    box = trimesh.creation.box((10.0, 10.0, thin))
    return write_ply(folder / "plate.ply", box.vertices, box.faces)


@pytest.mark.parametrize("shape", ["sphere", "plate"])
def test_triangles_are_about_as_many_as_were_told(shape: str, tmp_path: Path) -> None:
    given = "sphere" if shape == "sphere" else plate(tmp_path, 0.6)
    done = run(given, n=8, folder=tmp_path / "run", init={"iterations": 5}, threads=1)
    told = done.metrics["classify"]["effort"]["triangles"]
    assert told / 2 < done.metrics["sphere-train"]["trained_faces"] < 2 * told


def test_a_thinner_plate_takes_more(tmp_path: Path) -> None:
    told = []
    for thin in (2.0, 0.5, 0.2):
        folder = tmp_path / str(thin)
        folder.mkdir()
        done = run(plate(folder, thin), n=8, until="classify", folder=folder / "run")
        told.append(done.metrics["classify"]["effort"]["triangles"])
    # Edges as long as a flat wall is thick: 200 units of area for two sides.
    assert told[0] < told[1] < told[2]
    assert told[2] == pytest.approx(1.1 * 200 / (0.433 * 0.2**2), rel=0.3)


def test_what_takes_too_much_is_refused(tmp_path: Path, cli: Cli) -> None:
    path = plate(tmp_path, 0.01)
    done = cli("run", path, "-n", 8, cwd=tmp_path)
    assert done.returncode == 3
    assert "triangles, more than 400,000, because the shape or its gaps are thin" in done.stderr
    assert "edges of 0.01 at (" in done.stderr
    assert not (tmp_path / "plate.vorolight").exists()
    done = cli("classify", path, "-n", 8, "--allow-poor-input", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = cli("classify", "sphere", "-n", 25, "--max-time", 10, cwd=tmp_path)
    assert done.returncode == 3
    assert "CPU seconds" in done.stderr
    assert "more than --max-time 10: raise it, or lower -n" in done.stderr
    done = cli("classify", "sphere", "-n", 6, "--max-time", 100, "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["metrics"]["effort"]["cpu_seconds"] < 100


def test_thin_parts_are_lost_only_where_no_surface_is_known(tmp_path: Path, cli: Cli) -> None:
    mesh = plate(tmp_path, 0.2)
    field = "min(x**2 + y**2 + z**2 - 9, max(abs(x) - 5, abs(y) - 5, abs(z) - 0.1))"
    for words, lost in ((["classify", mesh], False), (["classify", "--field", field], True)):
        done = cli(*words, "-n", 8, "--run", f"run-{lost}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("may be lost" in done.stderr) == lost
