"""The paper's tables as a few small runs: that they are made, resume, and say what failed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SCRIPT = Path(__file__).parent / "benchmarks" / "tables.py"


def tables(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, "--quick", "--work", folder, "--output", folder / "page.md"]
    return subprocess.run(
        [*map(str, command), *map(str, words)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
    )


def test_a_part_is_made_once_and_the_page_says_what_is_not_run(tmp_path: Path) -> None:
    done = tables(tmp_path, "--only", "inner")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.md").read_text()
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith(("| 20 ", "| 40 "))]
    # Cells are the surface's and the inner ones; none of the surface's faces is changed.
    assert [int(row[1]) - int(row[0].strip("| ")) for row in rows] == [int(rows[0][1]) - 20] * 2
    assert [row[2] for row in rows] == ["0", "0"]
    assert page.count("not run") == 6
    picture = np.asarray(Image.open(tmp_path / "inner.png"))
    assert picture.shape[1] == 2 * 120
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.h5")}
    # A run that was stopped leaves the others as they are.
    volumes = sorted(tmp_path.glob("*inner20*/volume.json"))
    assert len(volumes) == 1
    volumes[0].unlink()
    assert tables(tmp_path, "--only", "inner").returncode == 0
    changed = [path for path, when in before.items() if path.stat().st_mtime_ns != when]
    assert [path.parent.name for path in changed] == [volumes[0].parent.name]
    assert (tmp_path / "page.md").read_text() == page


def test_a_mesh_that_cannot_be_run_is_said_so_in_its_row(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    (data / "broken.ply").write_bytes(b"ply\nno")
    done = tables(tmp_path / "work", "--data", data, "--only", "inner")
    assert done.returncode == 0, done.stderr
    assert "broken.ply: not a readable PLY file" in (tmp_path / "work" / "page.md").read_text()


@pytest.mark.slow
def test_every_part_is_made(tmp_path: Path) -> None:
    done = tables(tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.md").read_text()
    assert "not run" not in page
    for name in ("pipeline", "resolutions", "inner", "noise-torus"):
        assert f"]({name}.png)" in page
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
