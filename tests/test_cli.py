"""The real command line: results, up-to-date runs, bad input, exit codes, resuming."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from cases import snapshot
from conftest import QUICK, Cli, sphere_mesh, write_obj

from vorolight.stages.artifacts.hdf5 import read
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology

STAGES = ("classify", "init", "sphere-train", "volume", "fabricate")


def test_a_whole_run(heart_run: Path, manifest: Callable[[str], dict[str, Any]]) -> None:
    for stage in STAGES:
        record = manifest(stage)
        assert record["status"] == "complete"
        arrays, _ = read(heart_run / f"{stage}.h5", stage)
        assert arrays
    for stage in ("init", "sphere-train"):
        arrays, _ = read(heart_run / f"{stage}.h5", stage)
        facts = topology(PolygonMesh.from_arrays(arrays, "surface/"))
        assert facts.closed
        assert manifest(stage)["metrics"]["as_written"]["closed"]
    metrics = manifest("evaluate-sphere-train")["metrics"]
    assert metrics["gates"]["closed"] is True
    assert metrics["gates"]["certificate"] is True
    chamfer, diagonal = metrics["chamfer"], metrics["protocol"]["diagonal"]
    # A few iterations at n = 10 bring the surface to well within a voxel.
    spacing = manifest("classify")["metrics"]["spacing"]
    assert np.sqrt(chamfer["cd2"] / 2) * diagonal < 0.5 * spacing
    assert 0.9 < metrics["curvature"]["mean"] < 1.5
    assert not any(manifest("volume")["metrics"]["faults"].values())
    assert manifest("volume")["metrics"]["volume_error"] < 1e-6
    page = (heart_run / "report.html").read_text()
    spots = [
        check["name"]
        for check in manifest("fabricate")["metrics"]["printability"]
        if check["worst"] and check["name"] != "stability"
    ]
    assert page.count("<img") == 3 + len(spots)
    assert all(f'<img alt="{name}"' in page for name in spots)
    assert "pair_area_share" in page


def test_training_makes_the_surface_smoother_and_truer(heart_run: Path) -> None:
    history = read(heart_run / "sphere-train.h5", "sphere-train")[0]["history"]
    assert history.shape == (20, 4)
    # The weights of intersection and exclusion are ramped up tenfold over the first half; still
    # pairs come into being, intruders go, and the remeshed and fitted start keeps its distance.
    # The start may have all its pairs already: then less is missing than one pair's share.
    assert history[-1, 0] < max(0.2 * history[0, 0], 1e-4)
    assert history[-1, 1] < 0.2 * history[0, 1]
    assert history[-1, 2] < 2 * history[0, 2]
    first = read(heart_run / "init.h5", "init")[0]["history"]
    # Mirrored in the surface, the generators start near it, and get nearer.
    assert first[0, 0] < 0.04
    assert first[-1, 0] < 0.8 * first[0, 0]


def test_nothing_runs_twice(heart_run: Path, cli: Cli) -> None:
    before = snapshot(heart_run)
    done = cli(
        "run", "heart", "-n", 10, "--lamp", *QUICK, "--threads", 2, "-q", cwd=heart_run.parent
    )
    assert done.returncode == 0
    after = snapshot(heart_run)
    before.pop("report.html")
    after.pop("report.html")
    assert before == after
    seen = cli("status", "--json", cwd=heart_run.parent)
    states = [json.loads(line) for line in seen.stdout.splitlines()]
    assert {entry["state"] for entry in states} == {"done"}
    assert {entry["stage"] for entry in states} >= {*STAGES, "evaluate-sphere-train"}


def test_a_manifest_from_before_an_option_was_there_is_stale(tmp_path: Path, cli: Cli) -> None:
    assert cli("init", "sphere", "-n", 6, "--iterations", 2, cwd=tmp_path).returncode == 0
    path = tmp_path / "sphere.vorolight" / "init.json"
    record = json.loads(path.read_text())
    del record["params"]["shape_loss"]
    record["fingerprint"] = "0" * 64
    del record["checksum"]
    path.write_text(json.dumps(record))
    done = cli("init", "--iterations", 2, "--dry-run", cwd=tmp_path)
    assert "shape_loss None -> distance" in done.stdout


def test_dry_run_says_why(heart_run: Path, cli: Cli) -> None:
    before = snapshot(heart_run)
    done = cli("init", "-n", 11, "--dry-run", cwd=heart_run.parent)
    assert "n_init 10 -> 11" in done.stdout
    done = cli("volume", "--inner", 21, "--cvt-iterations", 5, "--dry-run", cwd=heart_run.parent)
    assert "inner 20 -> 21" in done.stdout
    assert snapshot(heart_run) == before


def test_run_without_input_goes_on_with_the_resolution(heart_run: Path, cli: Cli) -> None:
    done = cli("run", "--until", "classify", "--dry-run", cwd=heart_run.parent)
    assert done.stdout.strip() == "classify: up to date"


def test_touch_renews_only_the_time(heart_run: Path, cli: Cli) -> None:
    path = heart_run / "classify.json"
    content = path.read_bytes()
    os.utime(path, (1, 1))
    done = cli("classify", "-n", 10, "--touch", cwd=heart_run.parent)
    assert "up to date" in done.stdout
    assert path.stat().st_mtime > 1
    assert path.read_bytes() == content


def test_evaluate_as_json_and_against_a_reference(heart_run: Path, cli: Cli) -> None:
    reference = heart_run / "sphere-train.ply"
    words = ["--of", "init", "--samples", 4000, "--reference", reference, "--json", "--strict"]
    done = cli("evaluate", *words, cwd=heart_run.parent)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["metrics"]["protocol"]["reference"] == "sphere-train"
    assert {entry["role"] for entry in record["inputs"]} == {"input", "reference"}
    done = cli("evaluate", "--of", "volume", "--samples", 4000, "-q", cwd=heart_run.parent)
    assert done.returncode == 0, done.stderr
    for stem in ("evaluate-init", "evaluate-volume"):
        for path in heart_run.glob(f"{stem}.*"):
            path.unlink()


def test_stages_one_by_one_from_a_mesh_file(tmp_path: Path, cli: Cli) -> None:
    vertices, triangles = sphere_mesh(3.0, 2)
    path = write_obj(tmp_path / "ball.obj", vertices, triangles)
    content = path.read_bytes()
    for words in (
        ["init", "ball.obj", "-n", 8, "--iterations", 10, "--target-samples", 3000],
        ["sphere-train", "--iterations", 20, "--target-samples", 3000],
        ["volume", "--inner", 10, "--cvt-iterations", 3],
        ["evaluate", "--samples", 3000],
        ["fabricate", "--height", 40, "--sides", 6, "--tube-diameter", 1],
        ["report"],
    ):
        done = cli(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    run = tmp_path / "ball.vorolight"
    assert path.read_bytes() == content
    volume = json.loads((run / "volume.json").read_text())["metrics"]["enclosed_volume"]
    assert volume == pytest.approx(4 / 3 * np.pi * 27, rel=0.1)
    assert json.loads((run / "fabricate.json").read_text())["metrics"]["up"] == "y"
    write_obj(path, vertices * 1.01, triangles)
    done = cli("status", cwd=tmp_path)
    assert "ball.obj changed" in done.stdout
    done = cli("volume", "--inner", 10, "--cvt-iterations", 3, cwd=tmp_path)
    assert done.returncode == 4
    assert "ball.obj changed" in done.stderr


def test_config_file_and_precedence(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "a.toml").write_text("[classify]\nn_init = 7\n[init]\niterations = 3\n")
    done = cli("init", "sphere", "--config", "a.toml", "--iterations", 2, "--json", cwd=tmp_path)
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert records[0]["params"]["n_init"] == 7
    assert records[1]["params"]["iterations"] == 2
    (tmp_path / "b.toml").write_text("[classify]\nresolution = 7\n")
    done = cli("init", "sphere", "--config", "b.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "resolution" in done.stderr


BAD = [
    (["init", "missing.obj"], 3, "no such file"),
    (["init", "empty.obj"], 3, "empty"),
    (["init", "text.obj"], 3, "no surface"),
    (["init", "nan.obj"], 3, "not finite"),
    (["init", "points.obj"], 3, "no surface"),
    (["init", "line.obj"], 3, "on a line"),
    (["init", "heart", "-n", 4], 2, "from 5 to 512"),
    (["init", "heart", "-n", 513], 2, "from 5 to 512"),
    (["init", "heart", "-n", "many"], 2, "valid integer"),
    (["init", "heart", "--weight-shape", -1], 2, "at least 0"),
    (["init", "heart", "--weight-shape", "nan"], 2, "must be a finite number"),
    (["init", "heart", "--weight-shape", "inf"], 2, "must be a finite number"),
    (["init", "missing.obj", "-v"], 3, "no such file"),
    (["init", "heart", "--device", "abacus"], 2, "cpu or cuda"),
    (["init", "heart", "--run", "unwritable/run"], 2, "cannot be created"),
    (["sphere-train"], 4, "no run folder"),
    (["sphere-train", "--run", "nowhere"], 4, "run: vorolight"),
    (["init"], 4, "no run folder"),
    (["run", "heart", "--until", "tomorrow"], 2, "must be one of"),
    (["sample", "unicorn"], 2, "no such sample"),
    (["status"], 4, "no run folder"),
    (["report", "--run", "nowhere"], 4, "no stage is done"),
]


@pytest.mark.parametrize(("words", "code", "reason"), BAD, ids=lambda value: str(value)[:40])
def test_bad_input(words: list[object], code: int, reason: str, tmp_path: Path, cli: Cli) -> None:
    files = {
        "empty.obj": "",
        "text.obj": "Dear friend,\nthis is no mesh.\n",
        "nan.obj": "v 0 0 nan\nv 1 0 0\nv 0 1 1\nf 1 2 3\n",
        "points.obj": "v 0 0 0\nv 1 0 0\nv 0 1 1\n",
        "line.obj": "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
        "unwritable": "a file where a folder should be",
    }
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    before = snapshot(tmp_path)
    done = cli(*words, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert reason in done.stderr
    assert ("Traceback" in done.stderr) == ("-v" in words)
    assert snapshot(tmp_path) == before
    assert {path.name for path in tmp_path.iterdir()} == set(files)


def test_a_run_of_another_input_is_left_alone(heart_run: Path, cli: Cli) -> None:
    before = snapshot(heart_run)
    done = cli("init", "sphere", "--run", heart_run, cwd=heart_run.parent)
    assert done.returncode == 4
    assert "contains a run of heart" in done.stderr
    assert snapshot(heart_run) == before


def test_an_input_of_the_same_name_is_another_input(tmp_path: Path, cli: Cli) -> None:
    assert cli("classify", "sphere", "-n", 6, cwd=tmp_path).returncode == 0
    write_obj(tmp_path / "sphere.obj", *sphere_mesh(1.0, 2))
    before = snapshot(tmp_path)
    done = cli("init", "sphere.obj", "-n", 6, cwd=tmp_path)
    assert done.returncode == 4
    assert "contains a run of sphere, not of sphere.obj" in done.stderr
    assert snapshot(tmp_path) == before


def test_a_failed_check_leaves_the_older_result(heart_run: Path, cli: Cli) -> None:
    before = snapshot(heart_run)
    program = (
        "import sys\n"
        "from vorolight.stages.fabrication import printcheck\n"
        "from vorolight.stages.errors import NumericalFailure\n"
        "def fail(paths, bodies): raise NumericalFailure('the check failed')\n"
        "printcheck.of_files = fail\n"
        "from vorolight.cli.app import main\n"
        "sys.argv = ['vorolight', 'fabricate', '--sides', '4', '--height', '60']\n"
        "main()"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=heart_run.parent, capture_output=True, text=True)
    assert done.returncode == 6
    assert "the check failed" in done.stderr
    assert snapshot(heart_run) == before


def test_damaged_artifacts_are_refused(tmp_path: Path, cli: Cli) -> None:
    assert cli("init", "sphere", "-n", 6, "--iterations", 2, cwd=tmp_path).returncode == 0
    data = tmp_path / "sphere.vorolight" / "init.h5"
    data.write_bytes(data.read_bytes()[:-100])
    done = cli("sphere-train", cwd=tmp_path)
    assert done.returncode == 4
    assert "init.h5 changed" in done.stderr
    manifest = tmp_path / "sphere.vorolight" / "init.json"
    manifest.write_text(manifest.read_text().replace('"stage": "init"', '"stage": "other"'))
    done = cli("sphere-train", cwd=tmp_path)
    assert done.returncode == 4
    assert "breaks its schema" in done.stderr


def test_sample_is_the_installed_file(tmp_path: Path, cli: Cli) -> None:
    done = cli("sample", "cube", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stdout.strip() == "cube.obj"
    assert (tmp_path / "cube.obj").stat().st_size > 100
    (tmp_path / "cube.obj").write_text("mine")
    done = cli("sample", "cube", cwd=tmp_path)
    assert done.returncode == 2
    assert (tmp_path / "cube.obj").read_text() == "mine"


def test_a_plate_that_cannot_be_a_lamp_gets_all_the_rest(tmp_path: Path, cli: Cli) -> None:
    trimesh.creation.box((10, 3, 0.3)).export(tmp_path / "plate.stl")
    done = cli("run", "plate.stl", "-n", 8, "--lamp", *QUICK, cwd=tmp_path)
    assert done.returncode == 2
    assert re.search(r"--bed 250x250x250: the object is \d+ x \d+ mm wide", done.stderr)
    folder = tmp_path / "plate.vorolight"
    assert (folder / "report.html").is_file()
    assert not (folder / "fabricate.stl").exists()
    assert (folder / "evaluate-sphere-train.json").is_file()
    stored = json.loads((folder / "volume.json").read_text())
    assert stored["metrics"]["cell_volume_sum"] == pytest.approx(9, rel=1e-3)
