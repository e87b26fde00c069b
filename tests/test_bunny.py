"""The bunny, from the sample file to the lamp."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Cli


def figures(run: Path, stem: str) -> dict:
    return json.loads((run / f"{stem}.json").read_text())["metrics"]


def test_bunny_to_lamp(tmp_path: Path, cli: Cli) -> None:
    assert cli("sample", "bunny", cwd=tmp_path).returncode == 0
    words = ["-n", 14, "--lamp", "--threads", 2, "--inner", 100, "--cvt-iterations", 10,
             "--sides", 6, "--light-diameter", 25]  # fmt: skip
    done = cli("run", "bunny.obj", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "bunny.vorolight"
    evaluation = figures(run, "evaluate-sphere-train")
    assert evaluation["topology"]["bad_edges"] == 0
    # At n = 14 a cell is 0.04 of the diagonal; a surface without its ears would be below 0.8.
    assert evaluation["chamfer"]["f1"] > 0.9
    assert figures(run, "volume")["surface_unchanged"]
    lamp = figures(run, "fabricate")
    assert lamp["as_written"]["fault"] is None
    assert lamp["base"] == "footprint"
    assert lamp["light"]["proved_inside"]
    assert lamp["lattice"]["unexplained"] == 0
    assert lamp["printable"]
    assert lamp["as_written"]["size_mm"][2] == pytest.approx(120, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bunny", "heart"])
def test_figures_of_the_results(name: str, tmp_path: Path, cli: Cli) -> None:
    source = name
    if name == "bunny":
        assert cli("sample", "bunny", cwd=tmp_path).returncode == 0
        source = "bunny.obj"
    done = cli("run", source, "-n", 25, "--until", "evaluate", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    evaluation = figures(tmp_path / f"{name}.vorolight", "evaluate-sphere-train")
    assert evaluation["gates"]["closed"] is True
    if name == "bunny":
        assert evaluation["chamfer"]["f1"] >= 0.97
    else:
        # The paper's row of table 1.
        assert evaluation["sdf_loss"] <= 0.0013
        assert evaluation["trained"]["curvature"]["mean"] <= 1.48
