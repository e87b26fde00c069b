"""Sharp edges against creases, and |H| away from these."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import Cli, random_rotation, sphere_mesh

from vorolight.stages.artifacts.hdf5 import read
from vorolight.stages.formats import ply
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.metrics import creases, curvature
from vorolight.stages.metrics.creases import SHARP, STEP, TOLERANCE, Segments
from vorolight.stages.report import quality

HALF = 0.5
"""Half the edge of every cube here."""


def cube() -> PolygonMesh:
    """A cube of six squares."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return PolygonMesh.of_triangles(corners, np.array(faces))


def halved(mesh: PolygonMesh) -> PolygonMesh:
    """The same squares as triangles."""
    a, b, c, d = mesh.face_vertices.reshape(-1, 4).T
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return PolygonMesh.of_triangles(mesh.vertices, triangles)


def edges_of_cube() -> Segments:
    edges = creases.sharp_edges(cube())
    assert edges is not None
    return edges


def to_edges(points: np.ndarray) -> np.ndarray:
    """Distances of points inside the cube from its edges: the two sides nearest to them."""
    return np.linalg.norm(np.sort(HALF - np.abs(points), axis=1)[:, :2], axis=1)


def test_points_are_spread_evenly_over_uneven_pieces() -> None:
    at = np.array([0, 1e-4, 2e-4, 1.0, 1.0, 3.0])
    line = Segments(np.stack([at, 0 * at, 0 * at], 1), np.stack([np.arange(5), np.arange(1, 6)], 1))
    assert line.length == 3
    points = line.points(0.01)
    assert np.allclose(points[:, 0], 0.005 + 0.01 * np.arange(300))
    assert len(line.points(10.0)) == 1


def test_distances_from_edges_are_exact() -> None:
    points = np.random.default_rng(0).uniform(-HALF, HALF, (1000, 3))
    assert np.allclose(edges_of_cube().distance(points), to_edges(points), atol=1e-12)


def test_sharp_edges_are_those_between_faces() -> None:
    for mesh in (cube(), halved(cube())):
        edges = creases.sharp_edges(mesh)
        assert edges is not None
        assert edges.lengths == pytest.approx(np.full(12, 2 * HALF))
        assert creases.sharp_edges(mesh, 91.0) is None
    ball = PolygonMesh.of_triangles(*sphere_mesh(1.0, 3))
    assert creases.sharp_edges(ball) is None
    # An edge in one face is not sharp.
    lid = cube().select_faces(np.arange(6) > 0)
    edges = creases.sharp_edges(lid)
    assert edges is not None
    assert len(edges.lengths) == 8


def test_agreement_of_known_edges() -> None:
    truth, mesh = edges_of_cube(), halved(cube())

    def moved(by: float) -> creases.CreaseAgreement:
        other = mesh.with_vertices(mesh.vertices + np.array([0, 0, by]))
        return creases.agreement(truth, other, 2 * HALF, 0.1)

    same = moved(0)
    assert (same.edge_f1, same.edge_recall, same.edge_precision) == (1, 1, 1)
    assert same.distance_p99 == pytest.approx(0, abs=1e-9)
    assert (same.crease_length, same.sharp_length) == (12, 12)
    near = moved(0.9 * TOLERANCE)
    assert near.edge_f1 == 1
    # In units of the spacing; two thirds of the edges are moved across.
    assert near.distance_median == pytest.approx(0.9 * TOLERANCE / 0.1)
    far = moved(2 * TOLERANCE)
    # What is left are the four edges along the way, and what is next to their ends.
    assert far.edge_recall == pytest.approx(4 / 12, abs=4 * TOLERANCE)
    assert far.edge_precision == pytest.approx(far.edge_recall, abs=STEP * TOLERANCE)
    less = creases.agreement(truth, mesh.select_faces(np.arange(12) % 6 > 0), 2 * HALF, 0.1)
    assert less.edge_precision == 1
    assert less.edge_recall == pytest.approx(8 / 12, abs=4 * TOLERANCE)
    assert less.edge_f1 == pytest.approx(2 * less.edge_recall / (1 + less.edge_recall))


def test_agreement_depends_on_no_frame() -> None:
    turn, random = random_rotation(3), np.random.default_rng(1)
    mesh = halved(cube())
    shaken = mesh.with_vertices(mesh.vertices + random.normal(0, TOLERANCE, (8, 3)))
    truth = edges_of_cube()
    found = creases.agreement(truth, shaken, 1.0, 0.1)
    assert 0 < found.edge_f1 < 1
    large = Segments(7 * truth.vertices @ turn.T + 5, truth.ends)
    again = creases.agreement(
        large, shaken.with_vertices(7 * shaken.vertices @ turn.T + 5), 7.0, 0.7
    )
    assert again.edge_f1 == pytest.approx(found.edge_f1, abs=1e-3)
    assert again.distance_median == pytest.approx(found.distance_median, rel=1e-6)


def test_without_sharp_edges_f1_is_nought() -> None:
    ball = PolygonMesh.of_triangles(*sphere_mesh(HALF, 3))
    found = creases.agreement(edges_of_cube(), ball, 2 * HALF, 0.1)
    assert (found.edge_f1, found.edge_recall, found.edge_precision) == (0, 0, 0)
    assert found.distance_median is None
    assert found.sharp_length == 0


def test_curvature_off_creases_leaves_out_what_reaches_them() -> None:
    """On a cube |H| is 0 but where fits reach over an edge."""
    mesh = halved(cube())
    every, off = curvature.resampled(
        mesh.vertices, mesh.face_vertices.reshape(-1, 3), 0.06, edges_of_cube().distance
    )
    assert every is not None
    assert off is not None
    assert every.mean > 0.5
    assert off.p95 == pytest.approx(0, abs=1e-9)
    nowhere = curvature.resampled(
        mesh.vertices, mesh.face_vertices.reshape(-1, 3), 0.06, lambda at: np.zeros(len(at))
    )
    assert nowhere[1] is None


def figures(run: Path, stem: str) -> dict[str, Any]:
    return json.loads((run / f"{stem}.json").read_text())["metrics"]


def test_references_without_creases_have_none(tmp_path: Path, cli: Cli) -> None:
    ball = PolygonMesh.of_triangles(*sphere_mesh(HALF, 3))
    (tmp_path / "ball.ply").write_bytes(ply.encode(ball))
    (tmp_path / "cube.ply").write_bytes(ply.encode(halved(cube())))
    assert cli("classify", "ball.ply", "-n", 8, "-q", cwd=tmp_path).returncode == 0
    words = ("evaluate", "--surface", "ball.ply", "--samples", 2000)
    done = cli(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = figures(tmp_path / "ball.vorolight", "evaluate-file-ball")
    for key in ("creases", "curvature_off_creases", "resampled_curvature_off_creases",
                "reference_curvature_off_creases"):  # fmt: skip
        assert found[key] is None
    assert "edge F1" not in done.stdout
    done = cli(*words, "--reference", "cube.ply", "--require", "edge_f1>=0.9", cwd=tmp_path)
    assert done.returncode == 5
    assert "creases.edge_f1 is 0, but >= 0.9 is required" in done.stderr
    assert "edge F1@0.005" in done.stdout
    found = figures(tmp_path / "ball.vorolight", "evaluate-file-ball")
    assert found["reference_creases"]["edge_f1"] == 1


@pytest.fixture(scope="module")
def cavity_run(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """A cube of edge 1 with a ball of radius 0.4 taken out; its walls are thicker than the radius
    of the fits, a voxel."""
    folder = tmp_path_factory.mktemp("cavity")
    words = ("-n", 11, "--init-iterations", 20, "--until", "sphere-train", "-q")
    done = cli("run", "cube-cavity", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    done = cli("evaluate", "--samples", 5000, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "edge F1@0.005" in done.stdout
    return folder / "cube-cavity.vorolight"


def assert_untroubled(run: Path, euler_number: int) -> None:
    """Mirrored in a flat face, voxel centres form a lattice: the worst case for circumcentres."""
    history = read(run / "init.h5", "init")[0]["history"]
    # Shape (a fifth of a voxel, squared), normals, areas, centroids: none of them runs away.
    assert history[-1, 0] < 0.04
    assert history.max() < 2
    record = json.loads((run / "sphere-train.json").read_text())["metrics"]
    assert record["as_written"]["closed"]
    assert record["certificate"]["holds"]
    assert record["trained_topology"]["euler_number"] == euler_number


def test_flat_faces_make_no_trouble(cavity_run: Path) -> None:
    assert_untroubled(cavity_run, 4)


@pytest.mark.slow
def test_flat_faces_of_a_mesh_make_no_trouble(tmp_path: Path, cli: Cli) -> None:
    assert cli("sample", "cube", cwd=tmp_path).returncode == 0
    words = ("-n", 8, "--init-iterations", 20, "--until", "sphere-train")
    done = cli("run", "cube.obj", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert_untroubled(tmp_path / "cube.vorolight", 2)
    done = cli("evaluate", "--samples", 2000, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_cube_with_a_cavity_has_its_edges(cavity_run: Path) -> None:
    found = figures(cavity_run, "evaluate-sphere-train")["creases"]
    assert found["edge_f1"] > 0.98
    assert found["distance_median"] < 1e-3
    assert found["distance_p99"] < 0.02
    assert found["crease_length"] == pytest.approx(12, rel=1e-3)
    assert found["sharp_angle"] == SHARP
    done = json.loads((cavity_run / "evaluate-sphere-train.json").read_text())
    assert "edge F1" in quality.evaluations({"evaluate-sphere-train": done})


def test_a_cube_with_a_cavity_is_as_smooth_as_it_should_be(cavity_run: Path) -> None:
    metrics = figures(cavity_run, "evaluate-sphere-train")
    with h5py.File(cavity_run / "evaluate-sphere-train.h5") as file:
        at, size = file["surface/vertices"][:], file["mean_curvature"][:]
    radius = metrics["curvature_settings"]["radius"]
    assert radius < 0.1
    off = ~np.isnan(size) & (to_edges(at) > radius)
    within = np.linalg.norm(at, axis=1) < 0.45
    assert size[off & ~within].mean() < 0.02
    assert size[off & within].mean() == pytest.approx(2.5, rel=0.05)
    # By areas: those of the faces are without a margin as wide as the radius.
    areas = np.array([6 * (1 - 2 * radius) ** 2, 4 * np.pi * 0.4**2])
    truth = areas @ [0, 2.5] / areas.sum()
    for key in ("curvature_off_creases", "reference_curvature_off_creases"):
        assert metrics[key]["mean"] == pytest.approx(truth, rel=0.05)
    assert metrics["curvature"]["mean"] > 1.2 * metrics["curvature_off_creases"]["mean"]
