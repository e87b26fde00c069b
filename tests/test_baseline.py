"""The baseline VoroMesh: its loss by hand, its stage on a sphere, its command."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli, fibonacci, sphere_mesh, write_obj, write_ply

from vorolight.stages import baseline, classify
from vorolight.stages.artifacts.hdf5 import read
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.baselines import voromesh
from vorolight.stages.baselines.sampling import even
from vorolight.stages.engine import freshness, registry, runner
from vorolight.stages.engine.session import Session
from vorolight.stages.engine.stage import Stage
from vorolight.stages.errors import InputError, UsageError
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.mesh.geometry import enclosed_volume, fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology
from vorolight.stages.solvers.adam import Schedule
from vorolight.stages.voronoi.diagram.interface import interface

GRID = 12
QUICK = ["-n", 8, "--grid", GRID, "--epochs", 60, "--threads", 2]


def loss(
    generators: np.ndarray, samples: np.ndarray, grid: int = GRID, threads: int = 2
) -> tuple[float, np.ndarray]:
    with ThreadPoolExecutor(threads) as pool:
        return voromesh.voro_loss(np.array(generators, float), np.array(samples, float), grid, pool)


def slow_loss(generators: np.ndarray, samples: np.ndarray) -> float:
    """By the distance to every bisector of the nearest generator."""
    square = ((samples[:, None] - generators) ** 2).sum(axis=2)
    first = square.argmin(axis=1)
    length = np.linalg.norm(generators[first, None] - generators, axis=2)
    apart = 0.5 * (square - square[np.arange(len(samples)), first, None])
    distance = np.divide(apart, length, out=np.full_like(apart, np.inf), where=length > 0)
    return float((distance.min(axis=1) ** 2).mean())


def test_loss_of_two_generators_is_the_distance_to_their_bisector() -> None:
    value, gradient = loss([[-0.5, 0, 0], [0.5, 0, 0]], [[0.2, 0.3, -0.1]])
    assert value == pytest.approx(0.04)
    # The bisector moves half as far as either generator; away from it the sample turns it.
    assert gradient[:, 0] == pytest.approx([-0.2, -0.2])
    assert loss([[-0.5, 0, 0], [0.5, 0, 0]], [[0, 0.7, 0.1]])[0] == pytest.approx(0, abs=1e-30)


def test_loss_takes_the_nearest_wall_of_the_cell() -> None:
    generators = [[0, 0, 0], [0.4, 0, 0], [0, -0.9, 0], [0, 0, 0.9]]
    # From (0.05, -0.4, 0): walls at x = 0.2, y = -0.45, z = 0.45.
    assert loss(generators, [[0.05, -0.4, 0]])[0] == pytest.approx(0.05**2)
    # The mean over samples, the second at 0.1 from x = 0.2.
    assert loss(generators, [[0.05, -0.4, 0], [0.3, 0, 0]])[0] == pytest.approx(
        (0.05**2 + 0.1**2) / 2
    )
    assert loss([[0.1, 0, 0]], [[0.5, 0, 0]])[0] == 0  # a single cell has no walls


@pytest.mark.parametrize(("count", "grid"), [(12, 4), (12, 30), (400, 8), (400, 25)])
def test_loss_and_gradient_against_the_definition(count: int, grid: int) -> None:
    random = np.random.default_rng(count + grid)
    generators, samples = random.uniform(-1, 1, (count, 3)), random.uniform(-0.9, 0.9, (60, 3))
    value, gradient = loss(generators, samples, grid)
    assert value == pytest.approx(slow_loss(generators, samples), rel=1e-12)
    step = 1e-6
    for axis in range(3):
        for index in random.choice(count, 5, replace=False):
            moved = np.zeros_like(generators)
            moved[index, axis] = step
            ahead, behind = (slow_loss(generators + s * moved, samples) for s in (1, -1))
            assert gradient[index, axis] == pytest.approx(
                (ahead - behind) / (2 * step), rel=1e-4, abs=1e-9
            )


def test_loss_does_not_depend_on_the_threads() -> None:
    random = np.random.default_rng(3)
    generators, samples = random.uniform(-1, 1, (300, 3)), random.uniform(-1, 1, (1000, 3))
    (one, first), (two, second) = (loss(generators, samples, threads=t) for t in (1, 2))
    assert one == two
    assert (first == second).all()


def test_first_generators_are_the_corners_of_boxes_with_samples() -> None:
    found = voromesh.first_generators(np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2]]), 3)
    assert {tuple(row) for row in found} == {(x, y, z) for x in (0, 1) for y in (0, 1)
                                             for z in (0, 1)}  # fmt: skip
    frame = voromesh.CubeFrame.of_box(np.array([[1.0, 2, 3], [3, 3, 4]]))
    assert frame.cube_from_input(np.array([3.0, 2.5, 3.5])) == pytest.approx([0.9, 0, 0])


def test_rate_is_halved_at_the_published_epochs() -> None:
    schedule = Schedule(400, 5e-3, "halving", 50, halvings=voromesh.MILESTONES)
    rates = [schedule.rate_at(epoch) / 5e-3 for epoch in (0, 79, 80, 149, 150, 200, 250, 399)]
    assert rates == [1, 1, 0.5, 0.5, 0.25, 0.125, 0.0625, 0.0625]


def test_even_samples_keep_a_gap() -> None:
    from scipy.spatial import cKDTree

    direction = np.random.default_rng(0).standard_normal((6000, 3))
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    found = even(points, 2000, 2)
    gap = np.sqrt(4 * np.pi / 6000)
    assert len(found) == 2000
    assert cKDTree(found).query(found, k=2)[0][:, 1].min() > 0.9 * gap


def test_labels_make_a_closed_sphere() -> None:
    samples = fibonacci(3000, 0.9)
    places = voromesh.bounded(voromesh.first_generators(samples, GRID), np.random.default_rng(0))
    inside = voromesh.labels(places, lambda points: np.linalg.norm(points, axis=1) < 0.9)
    assert not inside[-8:].any()
    centres = voromesh.cell_centres(places)
    assert (inside[:-8] == (np.linalg.norm(centres[:-8], axis=1) < 0.9)).all()
    assert topology(interface(places, inside).mesh).euler_number == 2


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    folder = tmp_path_factory.mktemp("sphere")
    done = cli("baseline", "voromesh", "sphere", *QUICK, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "sphere.vorolight"


def test_sphere_from_the_command_line(sphere: Path) -> None:
    arrays, _ = read(sphere / "baseline.h5", "baseline")
    record = json.loads((sphere / "baseline.json").read_text())
    mesh = PolygonMesh.from_arrays(arrays, "surface/")
    radius = np.linalg.norm(mesh.vertices, axis=1)
    size = np.ptp(arrays["generators"], axis=0).max() / 2 * 0.9
    # Vertices are where four cells meet, off the surface by a part of the box's edge, 2 / 11.
    assert np.abs(radius / size - 1).max() < 0.1
    assert np.abs(radius / size - 1).mean() < 0.02
    assert topology(mesh).closed
    assert topology(mesh).euler_number == 2
    assert enclosed_volume(*fan_triangles(mesh)[:2]) == pytest.approx(
        4 / 3 * np.pi * size**3, rel=0.02
    )
    history = arrays["history"][:, 0]
    assert history.shape == (60,)
    assert history[-1] < 0.2 * history[0]
    assert record["metrics"]["as_written"]["closed"]
    assert record["metrics"]["generators"] == len(arrays["generators"]) - 8
    assert record["command"].startswith("vorolight baseline voromesh --grid 12")
    # The file is the interface of the generators that it names.
    again = interface(arrays["generators"], arrays["generator_inside"])
    assert again.mesh.face_count == mesh.face_count
    faces = arrays["surface/face_generators"]
    assert arrays["generator_inside"][faces].tolist() == [[True, False]] * len(faces)


def test_same_bytes_again_and_nothing_twice(sphere: Path, tmp_path: Path, cli: Cli) -> None:
    one = [str(word) for word in QUICK[:-2]] + ["--threads", "1"]
    assert cli("baseline", "voromesh", "sphere", *one, cwd=tmp_path).returncode == 0
    for suffix in ("h5", "ply"):
        there = tmp_path / "sphere.vorolight" / f"baseline.{suffix}"
        assert there.read_bytes() == (sphere / f"baseline.{suffix}").read_bytes()
    done = cli("baseline", "voromesh", *QUICK, cwd=sphere.parent)
    assert "baseline: up to date" in done.stdout
    done = cli("baseline", "voromesh", "--grid", 13, "--dry-run", cwd=sphere.parent)
    assert "baseline: would run (grid 12 -> 13)" in done.stdout
    states = [json.loads(x) for x in cli("status", "--json", cwd=sphere.parent).stdout.splitlines()]
    assert {x["stage"]: x["state"] for x in states}["baseline"] == "done"


def test_run_leaves_the_baseline_out(tmp_path: Path) -> None:
    assert "baseline" not in registry.ORDER
    session = Session(RunFolder(tmp_path / "run"), identify("sphere"))
    assert "baseline" not in {state.stage.name for state in freshness.overall(session)}


def test_clean_labels_for_a_noisy_cloud(tmp_path: Path) -> None:
    clean = write_ply(tmp_path / "clean.ply", *sphere_mesh())
    points = fibonacci(3000) + 0.01 * np.random.default_rng(1).standard_normal((3000, 3))
    noisy = tmp_path / "noisy.xyz"
    np.savetxt(noisy, points)
    session = Session(RunFolder(tmp_path / "run"), identify(str(noisy)), threads=2)
    runner.execute(session, "classify", classify.Params(n_init=6))

    def run(labels: Path) -> dict[str, Any]:
        params = baseline.Params(grid=GRID, epochs=20, labels=str(labels))
        return runner.execute(session, "baseline", params).manifest

    record = run(clean)
    assert record["metrics"]["topology"]["bad_edges"] == 0
    assert record["metrics"]["samples"] == 3000
    assert [entry["role"] for entry in record["inputs"]] == ["input", "labels"]
    with pytest.raises(InputError, match="--labels needs a mesh or a field"):
        run(noisy)
    far = write_obj(tmp_path / "far.obj", sphere_mesh()[0] + 100, sphere_mesh()[1])
    with pytest.raises(InputError, match=r"none of the .* lies inside the shape; check that"):
        run(far)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["poisson", "sphere"], 2, "METHOD poisson: must be one of voromesh"),
        (["voromesh", "nothing.ply"], 3, "no such file"),
        (["voromesh", "sphere", "--grid", "2"], 2, "--grid 2: must be from 4 to 512"),
    ],
)
def test_what_is_refused(words: list[str], code: int, said: str, tmp_path: Path, cli: Cli) -> None:
    done = cli("baseline", *words, cwd=tmp_path)
    assert done.returncode == code
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_params() -> None:
    with pytest.raises(UsageError, match="METHOD other"):
        baseline.Params("other")  # type: ignore[arg-type]
    stage: Stage = baseline.STAGE
    assert stage.extra_inputs(baseline.Params(labels="x.ply")) == {"labels": "x.ply"}
