"""Training: closed-form pairs, derivatives, duals, and certified runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import (
    Cli,
    assert_derivatives,
    random_rotation,
    sphere_mesh,
    surface_of,
    torus_mesh,
    write_ply,
)

from vorolight.stages import classify, init, sphere_train
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import runner
from vorolight.stages.engine.session import Session
from vorolight.stages.errors import NumericalFailure
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.mesh import geometry
from vorolight.stages.mesh.creases import Chain, Creases
from vorolight.stages.mesh.dual import dual
from vorolight.stages.mesh.edge_table import Sized
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import split_pinched, topology
from vorolight.stages.solvers.gauss_newton import descend, first_damping
from vorolight.stages.training import conforming as conforming_training
from vorolight.stages.training.losses import triangle_pairs as conforming
from vorolight.stages.training.sphere_problem import SphereProblem
from vorolight.stages.training.spheres import SAFE, Spheres, rings_around


def test_pairs_lie_on_the_three_spheres_of_their_face() -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    radii = 0.28 + 0.02 * np.sin(5 * vertices[:, 0])
    pairs = conforming.radical_pairs(vertices, radii, triangles)
    points = pairs.points(np.zeros(len(triangles)))
    for side in (points[: len(triangles)], points[len(triangles) :]):
        reach = np.linalg.norm(side[:, None] - vertices[triangles], axis=2)
        assert reach == pytest.approx(radii[triangles], abs=1e-12)
    assert (np.linalg.norm(points[: len(triangles)], axis=1) > 1).all()


def test_derivatives_of_spheres_against_finite_differences(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 1)
    surface = surface_of(tmp_path / "ball.ply", sphere_mesh(1.05, 3))
    random = np.random.default_rng(0)
    mesh = Sized(vertices + 0.03 * random.normal(size=vertices.shape), triangles, np.ones(42))
    spheres = Spheres.at(mesh)
    spheres = replace(
        spheres, radii=spheres.radii * (0.7 + 0.5 * random.random(42)), hold=random.random(42),
        rank=np.where(np.arange(42) < 2, 2, np.where(np.arange(42) < 9, 1, 0)),
    )  # fmt: skip
    spheres = replace(spheres, room=0.8 + 0.2 * random.random(42))
    creases = Creases([Chain(np.array([[-1.2, 0, 0.9], [0.1, 0.3, 1.0], [1.1, 0.2, 0.7]]), False)])
    weights = {"intersection": 3.0, "exclusion": 2.0, "shape": 5.0, "normal": 0.3, "smooth": 0.7,
               "radius": 0.4}  # fmt: skip
    problem = SphereProblem(spheres, surface, creases, weights, np.ones(42, bool), 1)
    problem.prepare(spheres, 1.0)
    residuals = problem.residuals(spheres)
    assert all((residuals[key] != 0).any() for key in weights)
    assert (residuals["exclusion"] == 0).any()
    assert_derivatives(problem, spheres)


def squeezed(height: float) -> Spheres:
    """A ball with a vertex ``height`` beside the middle of an edge opposite, or on it."""
    vertices, triangles = sphere_mesh(1.0, 1)
    a, b, c = triangles[0]
    vertices = vertices.copy()
    middle = 0.5 * (vertices[b] + vertices[c])
    vertices[a] = middle + height * (vertices[a] - middle)
    return Spheres.at(Sized(vertices, triangles, np.ones(len(vertices))))


WEIGHTS = {"intersection": 30.0, "exclusion": 30.0, "shape": 100.0, "normal": 0.0, "smooth": 0.02,
           "radius": 0.02}  # fmt: skip


@pytest.mark.parametrize("degrees", [20, 45, 90, 150])
def test_acute_creases_ask_for_less_room(degrees: float) -> None:
    angle = np.radians(degrees)
    outline = np.array([[0, 0, 0], [4, 0, 0], [4 * np.cos(angle), 4 * np.sin(angle), 0]])
    wedge = trimesh.convex.convex_hull(np.concatenate([outline, outline + np.array([0, 0, 4.0])]))
    corners = np.asarray(wedge.vertices)
    edge = np.flatnonzero(np.linalg.norm(corners[:, :2], axis=1) < 1e-9)
    mesh = Sized(corners, np.asarray(wedge.faces, np.int64), np.ones(6))
    mesh.creases = np.array([[*edge, 0]])
    expected = min(1.0, np.tan(angle / 2))
    room = Spheres.at(mesh).room
    assert room[edge] == pytest.approx(expected)
    assert np.delete(room, edge) == pytest.approx(1)


def test_pairs_that_are_far_from_existing_have_derivatives(tmp_path: Path) -> None:
    spheres = squeezed(0.15)
    surface = surface_of(tmp_path / "ball.ply", sphere_mesh(1.0, 3))
    weights = dict.fromkeys(WEIGHTS, 0.0) | {"intersection": 3.0}
    problem = SphereProblem(spheres, surface, None, weights, np.ones(42, bool), 1)
    problem.prepare(spheres, 1.0)
    assert problem.residuals(spheres)["intersection"].max() > 1.2 * np.sqrt(3.0)
    assert_derivatives(problem, spheres)


def test_a_triangle_without_area_stalls_nothing(tmp_path: Path) -> None:
    spheres = squeezed(0.0)
    surface = surface_of(tmp_path / "ball.ply", sphere_mesh(1.0, 3))
    points, square = spheres.generators()
    assert square.min() < -100
    assert np.linalg.norm(points, axis=1).max() < 3  # the diagram has to be bounded
    problem = SphereProblem(spheres, surface, None, WEIGHTS, np.ones(42, bool), 1)
    _, losses, damping = descend(problem, spheres, [1.0] * 6, first_damping(42))
    assert losses[-1].sum() < 0.5 * losses[0].sum()
    assert np.median(damping) < 1


def test_all_intruders_of_small_spheres_are_found() -> None:
    # As of short edges in a large shape: powers below SAFE are further away than the spheres' size.
    vertices, triangles = sphere_mesh(0.02, 2)
    spheres = Spheres.at(Sized(vertices, triangles, np.ones(len(vertices))))
    points, _ = spheres.generators()
    away = ((points[:, None] - spheres.centres) ** 2).sum(axis=2) - spheres.radii**2
    corners = np.tile(triangles, (2, 1))
    away[np.arange(len(points))[:, None], corners] = np.inf
    near = away.min(axis=0)
    assert 0 < (near < SAFE).sum() < len(near)
    assert np.array_equal(spheres.intrusion(1) > 0, near < SAFE)


def test_a_local_problem_takes_the_steps_of_the_whole_one(tmp_path: Path) -> None:
    # The sheets are so close that generators of either lie in spheres of the other.
    vertices, triangles = sphere_mesh(1.0, 3)
    vertices = vertices * [1, 1, 0.08]
    surface = surface_of(tmp_path / "lens.ply", (1.02 * vertices, triangles))
    spheres = Spheres.at(Sized(vertices, triangles, np.ones(len(vertices))))
    free = rings_around(triangles, vertices[:, 2] == vertices[:, 2].max(), 2)
    assert (spheres.intrusion(1)[free] > 0).any()
    found = []
    for local in (False, True):
        problem = SphereProblem(spheres, surface, None, WEIGHTS, free, 1, local)
        damping = first_damping(len(problem.vertices))
        part, _, _ = descend(problem, problem.start, [1.0] * 3, damping)
        found.append((spheres.with_part(problem.vertices, part), len(problem.vertices)))
    (whole, everything), (near, few) = found
    assert few < 0.5 * everything
    assert (whole.centres[free] != vertices[free]).any(axis=1).all()
    assert (near.centres[~free] == vertices[~free]).all()
    # The sums are those of the same numbers in another order.
    assert near.centres == pytest.approx(whole.centres, abs=1e-6)
    assert near.radii == pytest.approx(whole.radii, abs=1e-6)


def test_a_triangle_as_good_as_flat_pulls_at_nothing(tmp_path: Path) -> None:
    """What its pair misses is cut off, so is the derivative: it would be larger than all others."""
    surface = surface_of(tmp_path / "ball.ply", sphere_mesh(1.0, 3))
    for height, pulls in ((0.15, True), (1e-5, False)):
        spheres = squeezed(height)
        problem = SphereProblem(spheres, surface, None, WEIGHTS, np.ones(42, bool), 1)
        problem.prepare(spheres, 1.0)
        residuals = problem.residuals(spheres)
        flattest = int(spheres.pairs().square.argmin())
        short = -spheres.pairs().square[flattest] / spheres.face_lengths[flattest] ** 2
        assert (short > 1e3) != pulls
        pair = problem.blocks(spheres, residuals)[0]
        row = np.flatnonzero(np.flatnonzero(residuals["intersection"]) == flattest)
        assert pair.values[np.isin(pair.rows, row)].any() == pulls


def test_a_generator_in_the_plane_of_its_centres_follows_nothing() -> None:
    centres = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 3, 0]])
    columns, values = conforming.power_gradient(
        np.array([[1.0, 1, 0]]), np.array([[0, 1, 2]]), np.array([3]), centres, np.ones(4)
    )
    assert (values[0, :12] == 0).all()
    assert values[0, 12:].tolist() == [-2, 4, 0, -2]
    assert columns[0, 12:].tolist() == [12, 13, 14, 15]


@pytest.mark.parametrize("mesh", [sphere_mesh(1.0, 3), torus_mesh(1.0, 0.4, 40, 20)])
def test_the_dual_has_a_polygon_for_each_vertex(mesh: tuple) -> None:
    surface = PolygonMesh.of_triangles(*mesh)
    polygons = dual(surface)
    facts, own = topology(polygons), topology(surface)
    assert (facts.vertices, facts.faces) == (own.faces, own.vertices)
    assert facts.closed
    assert facts.euler_number == own.euler_number
    volume = geometry.enclosed_volume(*geometry.fan_triangles(polygons)[:2])
    assert volume == pytest.approx(geometry.enclosed_volume(*mesh), rel=0.05)
    with pytest.raises(ValueError, match="not closed"):
        dual(surface.select_faces(np.arange(own.faces) > 0))


def test_a_pinched_vertex_is_split() -> None:
    vertices, triangles = sphere_mesh(1.0, 1)
    top = int(vertices[:, 2].argmax())
    other = vertices * [1, 1, -1] + [0, 0, 2 * vertices[top, 2]]
    faces = triangles[:, ::-1] + len(vertices)
    faces[faces == top + len(vertices)] = top
    mesh = PolygonMesh.of_triangles(
        np.concatenate([vertices, other]), np.concatenate([triangles, faces])
    )
    assert topology(mesh).pinched_vertices == 1
    with pytest.raises(ValueError, match="not one fan"):
        dual(mesh)
    split = topology(split_pinched(mesh))
    assert (split.pinched_vertices, split.euler_number, split.components) == (0, 4, 2)


def result(run: Path, stem: str = "sphere-train") -> dict:
    return json.loads((run / f"{stem}.json").read_text())["metrics"]


def test_a_certified_run_and_its_evaluation(heart_run: Path) -> None:
    trained, found = result(heart_run), result(heart_run, "evaluate-sphere-train")
    assert trained["certificate"]["holds"]
    assert trained["faces_after_merging"] == trained["trained_faces"]
    assert trained["conformity"]["pair_area_share"] > 0.99999
    assert trained["topology"] == trained["trained_topology"]
    assert trained["as_written"]["certified_topology"]
    for key in ("holds", "failed", "intruders", "bad_rings", "turned_faces", "wound_wrongly"):
        assert found["certificate"][key] == trained["certificate"][key]
    assert found["certificate"]["margin"] == pytest.approx(trained["certificate"]["margin"])
    assert found["gates"]["certificate"] is True
    # Walls of the volume and faces of the surface are the same.
    assert result(heart_run, "volume")["boundary_faces"] == trained["trained_faces"]


@pytest.mark.slow
def test_turned_and_scaled_meshes_give_the_same_surface(tmp_path: Path, cli: Cli) -> None:
    vertices, triangles = torus_mesh(1.0, 0.45, 40, 20)
    vertices = vertices + [0, 0, 0.05] * np.sin(3 * vertices[:, :1])
    write_ply(tmp_path / "a.ply", vertices, triangles)
    write_ply(tmp_path / "b.ply", 4 * vertices, triangles)
    write_ply(tmp_path / "c.ply", 1.37 * vertices @ random_rotation(1).T, triangles)
    for name in "abc":
        for words in (
            ["init", f"{name}.ply", "-n", 10, "--iterations", 3],
            ["sphere-train"],
            ["evaluate", "--samples", 5000],
        ):
            where = [] if words[0] == "init" else ["--run", f"{name}.vorolight"]
            done = cli(*words, *where, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
    runs = [tmp_path / f"{name}.vorolight" for name in "abc"]
    from vorolight.stages.artifacts.hdf5 import read

    first, second = (read(run / "sphere-train.h5", "sphere-train")[0] for run in runs[:2])
    assert np.array_equal(4 * first["surface/vertices"], second["surface/vertices"])
    assert np.array_equal(first["surface/face_vertices"], second["surface/face_vertices"])
    figures = [result(run, "evaluate-sphere-train") for run in runs]
    assert all(found["certificate"]["holds"] for found in figures)
    assert {found["topology"]["euler_number"] for found in figures} == {0}
    areas = [found["area"] / scale**2 for found, scale in zip(figures, (1, 4, 1.37), strict=True)]
    assert areas[2] == pytest.approx(areas[0], rel=0.02)


def test_the_paper_preset_splits_polygons_at_their_centroids(tmp_path: Path, cli: Cli) -> None:
    words = ["-n", 8, "--init-iterations", 5, "--sphere-train-iterations", 20]
    done = cli("run", "sphere", *words, "--preset", "paper", "--until", "sphere-train",
               cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "sphere.vorolight" / "sphere-train.json").read_text())
    started = result(tmp_path / "sphere.vorolight", "init")["topology"]
    assert record["metrics"]["trained_topology"]["faces"] > 3 * started["faces"]
    assert not record["metrics"]["certificate"]["holds"]
    assert any("no certificate" in warning for warning in record["warnings"])


def test_without_a_certificate_training_ends_with_the_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conforming_training, "ROUNDS", 0)
    path = write_ply(tmp_path / "ring.ply", *torus_mesh(1.0, 0.3, 40, 16))
    session = Session(RunFolder(tmp_path / "ring.vorolight"), identify(str(path)))
    runner.execute(session, "classify", classify.Params(n_init=8))
    runner.execute(session, "init", init.Params(iterations=0))
    with pytest.raises(NumericalFailure, match=r"no certificate .* worst at \(.* thick") as caught:
        runner.execute(session, "sphere-train", sphere_train.Params(iterations=0))
    places = re.findall(r"\(([-\d.e]+), ([-\d.e]+), ([-\d.e]+)\)", str(caught.value))
    assert 1 <= len(places) <= 3
    around = np.array(places, float)
    off = np.hypot(np.hypot(around[:, 0], around[:, 1]) - 1, around[:, 2]) - 0.3
    assert np.abs(off).max() < 0.05
    assert not (tmp_path / "ring.vorolight" / "sphere-train.json").exists()
    params = sphere_train.Params(iterations=0, allow_uncertified=True)
    done = runner.execute(session, "sphere-train", params).manifest
    assert not done["metrics"]["certificate"]["holds"]
    assert any("no certificate" in warning for warning in done["warnings"])


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [30, 15, 10])
def test_wedges_are_certified(degrees: float, tmp_path: Path, cli: Cli) -> None:
    angle = np.radians(degrees)
    side = np.array([[0, 0, 0], [8, 0, 0], [8 * np.cos(angle), 8 * np.sin(angle), 0]])
    wedge = trimesh.convex.convex_hull(np.concatenate([side, side + np.array([0, 0, 6])]))
    path = write_ply(tmp_path / "wedge.ply", wedge.vertices, wedge.faces)
    words = ["-n", 15, "--init-iterations", 5, "--until", "sphere-train"]
    assert cli("run", path, *words, cwd=tmp_path).returncode == 0
    found = result(tmp_path / "wedge.vorolight", "sphere-train")
    assert found["certificate"]["holds"]
    assert found["trained_topology"]["euler_number"] == 2
    written = trimesh.load_mesh(tmp_path / "wedge.vorolight" / "sphere-train.ply", process=False)
    assert written.is_watertight
    assert written.volume == pytest.approx(wedge.volume, rel=2e-3)


def test_what_takes_too_many_triangles_is_refused_before_training(tmp_path: Path, cli: Cli) -> None:
    box = trimesh.creation.box((4.0, 3.0, 0.02))
    path = write_ply(tmp_path / "sheet.ply", box.vertices, box.faces)
    words = ["-n", 8, "--init-iterations", 0, "--until", "sphere-train"]
    done = cli("run", path, *words, "--max-faces", 3000, cwd=tmp_path)
    assert done.returncode == 6
    assert "more than --max-faces 3000" in done.stderr
    assert done.stderr.count("edges of 0.02") == 3
    assert not (tmp_path / "sheet.vorolight" / "sphere-train.json").exists()
    box = trimesh.creation.box((4.0, 3.0, 0.002))
    path = write_ply(tmp_path / "foil.ply", box.vertices, box.faces)
    done = cli("run", path, *words, "--allow-poor-input", cwd=tmp_path)
    assert done.returncode == 6
    assert "more than --max-faces 400000" in done.stderr


def test_losses_that_an_input_does_not_have(tmp_path: Path, cli: Cli) -> None:
    assert cli("init", "sphere", "-n", 6, "--iterations", 0, cwd=tmp_path).returncode == 0
    for words, message in (
        (["--shape-loss", "chamfer"], "add --preset paper"),
        (["--preset", "paper", "--shape-loss", "chamfer"], "a field has no points to compare with"),
        (["--learning-rate", 0.1], "add --preset paper"),
        (["--preset", "paper", "--edge-length", 0.5], "not used in this training"),
    ):
        done = cli("sphere-train", *words, cwd=tmp_path)
        assert done.returncode == 2
        assert message in done.stderr


def test_many_inner_generators_keep_the_certificate(tmp_path: Path, cli: Cli) -> None:
    words = ["-n", 6, "--init-iterations", 0, "--until", "volume", "--inner", 400]
    done = cli("run", "sphere", *words, "--cvt-iterations", 5, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert result(tmp_path / "sphere.vorolight", "volume")["surface_unchanged"]
