from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import Runs
from hypothesis import settings
from trials import Server

from vorolight.stages.engine import registry
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.mesh.geometry import face_frames
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.queries.true_surface import TrueSurface
from vorolight.stages.render.cameras import Camera
from vorolight.stages.solvers.gauss_newton import Problem

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
settings.register_profile("tests", deadline=None, max_examples=15, derandomize=True)
settings.load_profile("tests")

QUICK = ["--init-iterations", "15", "--sphere-train-iterations", "20", "--inner", "20",
         "--cvt-iterations", "5", "--samples", "5000", "--sides", "6",
         "--faces", "triangle"]  # fmt: skip
Cli = Callable[..., subprocess.CompletedProcess[str]]
AT_START = ("PYTHON", "NUMBA", "OMP", "LANG", "LC_")
"""How the names begin of variables that are read once, at the start of a process."""
LONG = (
    "test_lamps", "test_cli", "test_points", "test_conforming", "test_corruptions", "test_kills",
    "test_conditions", "test_spacing", "test_polygons", "test_grid", "test_cluster", "test_engine",
    "test_rounded", "test_crease_metrics", "test_running", "test_determinism", "test_appearance",
    "test_creases", "test_report", "test_baseline", "test_remeshing", "test_volume", "test_bunny",
    "test_images", "test_cloud_file", "test_packages", "test_tables", "test_expression",
)  # fmt: skip
"""Files of tests that take long, the longest first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first: of two workers none shall begin one when the other has nothing left."""
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.fixture(autouse=True)
def _two_threads() -> None:
    import torch

    torch.set_num_threads(2)


@pytest.fixture(scope="session")
def commands() -> dict[str, Any]:
    """Every command with all its options, by name."""
    import typer.main

    from vorolight.cli import app

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COMP_WORDS", " ".join([*registry.ALL, "run"]))
        app._build()
    group: Any = typer.main.get_command(app.app)
    assert len(group.commands) >= 16
    return dict(group.commands)


@pytest.fixture(scope="session")
def program() -> Cli:
    """The real command line in a new process: where its start, its imports or the variables that
    the interpreter reads are what is tested. It costs a second or two more than ``cli``."""

    def call(*words: object, cwd: Path, **more: Any) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "vorolight.cli", *map(str, words)]
        environment = {**os.environ, **more.pop("env", {})}
        return subprocess.run(
            command, cwd=cwd, capture_output=True, text=True, timeout=300, env=environment, **more
        )

    return call


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A process that has imported everything, and forks."""
    with Server() as found:
        yield found


@pytest.fixture(scope="session")
def cli(request: pytest.FixtureRequest, program: Cli) -> Cli:
    """The real command line in a process of its own: a fork, where that can be done, of one that
    has imported everything."""
    if not sys.platform.startswith("linux"):
        return program
    forking: Server = request.getfixturevalue("server")

    def call(*words: object, cwd: Path, **more: Any) -> subprocess.CompletedProcess[str]:
        env = more.get("env", {})
        # What is read while Python and the libraries start has no effect on a fork.
        if more.keys() - {"env"} or any(name.startswith(AT_START) for name in env):
            return program(*words, cwd=cwd, **more)
        return forking.call(words, cwd, {**os.environ, **env})

    return call


@pytest.fixture(scope="session")
def runs(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """Small runs up to any stage, each made once."""
    return Runs(server, tmp_path_factory.mktemp("runs"))


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that ``make`` filled, once for all workers of pytest-xdist; each has a copy."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    place, done, failed = (base / f"{name}{end}" for end in ("", ".done", ".failed"))
    try:
        place.mkdir()
    except FileExistsError:
        while not done.exists():
            assert not failed.exists(), f"{name}: another worker could not make it"
            time.sleep(0.1)
    else:
        try:
            make(place)
        except BaseException:
            failed.touch()
            raise
        done.touch()
    return shutil.copytree(place, factory.mktemp(name), dirs_exist_ok=True)


@pytest.fixture(scope="session")
def heart_run(tmp_path_factory: pytest.TempPathFactory, program: Cli) -> Path:
    """The folder of a small but whole run on the heart, lamp included."""

    def make(folder: Path) -> None:
        words = ["-n", 10, "--lamp", *QUICK, "--threads", 2]
        done = program("run", "heart", *words, cwd=folder)
        assert done.returncode == 0, done.stderr

    return made_once(tmp_path_factory, "heart", make) / "heart.vorolight"


@pytest.fixture
def manifest(heart_run: Path) -> Callable[[str], dict[str, Any]]:
    return lambda stem: json.loads((heart_run / f"{stem}.json").read_text())


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    """Write a mesh as it is; the path."""
    import trimesh

    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    return path


def write_obj(path: Path, vertices: np.ndarray, faces: object) -> Path:
    lines = ["v {:.17g} {:.17g} {:.17g}".format(*v) for v in vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def surface_of(path: Path, mesh: tuple, spacing: float = 1.0) -> TrueSurface:
    """The true surface of a mesh that is first written to ``path``."""
    frame = ModelFrame(np.zeros(3), spacing)
    return MeshSource(write_ply(path, *mesh)).true_surface(frame, threads=2)


CAMERA_MATRIX = np.array([[300.0, 2.0, 120.0], [0, 310.0, 90.0], [0, 0, 1]])


def camera(seed: int = 0, orthographic: bool = False) -> Camera:
    matrix = CAMERA_MATRIX.copy()
    if orthographic:
        matrix[:2, :2] /= 4
    return Camera(240, 180, matrix, random_rotation(seed), np.array([0.2, -0.1, 4.0]), orthographic)


def sphere_mesh(radius: float = 1.0, level: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """An icosphere's vertices and triangles."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def torus_mesh(major: float, minor: float, m: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.torus(major, minor, major_sections=m, minor_sections=n)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def random_rotation(seed: int) -> np.ndarray:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


def fibonacci(count: int, radius: float = 1.0) -> np.ndarray:
    """Points on a sphere, evenly."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    return radius * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def ball(seed: int = 0, count: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Random points of a cube, and which of them lie in a ball."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return points, np.linalg.norm(points, axis=1) < 0.6


def exact_pairs(
    vertices: np.ndarray, triangles: np.ndarray, radius: float
) -> tuple[PolygonMesh, np.ndarray, np.ndarray]:
    """Triangles with exact pairs, inside and outside: where equal spheres at their corners meet."""
    mesh = PolygonMesh.of_triangles(vertices, triangles)
    a, b, c = (mesh.vertices[mesh.face_vertices.reshape(-1, 3)[:, k]] for k in range(3))
    _, normal, _ = face_frames(mesh)
    ab, ac = b - a, c - a
    cross = np.cross(ab, ac)
    arm = np.cross(cross, ab) * (ac**2).sum(1, keepdims=True)
    arm = arm + np.cross(ac, cross) * (ab**2).sum(1, keepdims=True)
    arm = arm / (2 * (cross**2).sum(1, keepdims=True))
    offset = np.sqrt(radius**2 - (arm**2).sum(1, keepdims=True))
    return mesh, a + arm - offset * normal, a + arm + offset * normal


def slopes(problem: Problem, state: object, residuals: dict, count: int) -> np.ndarray:
    """Central differences of the residuals by every unknown."""
    step, columns = 1e-6, []
    for unknown in range(count):
        move = np.zeros(count)
        sides = []
        for sign in (1, -1):
            move[unknown] = sign * step
            parts = problem.residuals(problem.moved(state, move))
            sides.append(np.concatenate([parts[key] for key in residuals]))
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(columns, axis=1)


def assert_derivatives(problem: Problem, state: object) -> None:
    problem.prepare(state, 1.0)
    residuals = problem.residuals(state)
    count = len(problem.free)
    blocks = problem.blocks(state, residuals)
    # Whether or not the terms come in the same order, the gradient and J^T J are the same; rows
    # that are zero (inactive inequalities) have no part in either.
    measured = slopes(problem, state, residuals, count)
    values = np.concatenate([residuals[key] for key in residuals])
    gradient, square = np.zeros(count), np.zeros((count, count))
    for block in blocks:
        jacobian = np.zeros((len(block.residual), count))
        np.add.at(jacobian, (block.rows, block.columns), block.values)
        gradient += jacobian.T @ block.residual
        square += jacobian.T @ jacobian
    assert gradient == pytest.approx(measured.T @ values, abs=1e-5 * np.abs(gradient).max())
    assert square == pytest.approx(measured.T @ measured, abs=1e-5 * np.abs(square).max())
