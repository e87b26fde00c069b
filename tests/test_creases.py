"""Creases: found on meshes and fields, followed by edges, kept to by the training."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import Cli, random_rotation, sphere_mesh, surface_of, write_obj

from vorolight.stages.inputs.creases.contouring import contoured
from vorolight.stages.inputs.creases.sharp_edges import of_triangles
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.mesh.creases import (
    CORNER,
    CREASE,
    Chain,
    Creases,
    cut_ears,
    deviation,
    embed,
    give_up_flat,
)
from vorolight.stages.mesh.edge_table import EdgeTable, Sized
from vorolight.stages.mesh.geometry import triangle_normals
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.remesh.operations import contract_short, delaunay_gain, flip, split_long
from vorolight.stages.remesh.remeshing import remesh
from vorolight.stages.training.spheres import Spheres
from vorolight.stages.training.triangles import Trained


def cube(side: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A turned cube of many triangles."""
    mesh = trimesh.creation.box((side, side, side)).subdivide().subdivide().subdivide()
    return np.asarray(mesh.vertices) @ random_rotation(seed).T, np.asarray(mesh.faces, np.int64)


def test_creases_of_a_cube_and_of_a_cylinder() -> None:
    chains = of_triangles(*cube(5.0), 40.0)
    assert len(chains) == 12
    assert {round(chain.length, 9) for chain in chains} == {5.0}
    assert len(Creases(chains).corners) == 8
    assert of_triangles(*cube(5.0), 95.0) == []
    assert of_triangles(*cube(1.0), 40.0) == []  # smaller than two voxels: detail
    tube = trimesh.creation.cylinder(3.0, 6.0, sections=64)
    rims = of_triangles(np.asarray(tube.vertices), np.asarray(tube.faces, np.int64), 40.0)
    assert [chain.closed for chain in rims] == [True, True]
    assert rims[0].length == pytest.approx(2 * np.pi * 3.0, rel=1e-2)
    assert len(Creases(rims).corners) == 0


def test_what_is_round_or_rough_has_no_creases() -> None:
    vertices, triangles = sphere_mesh(5.0, 4)
    assert of_triangles(vertices, triangles, 40.0) == []
    rough = vertices + np.random.default_rng(0).normal(0, 0.1, vertices.shape)
    assert of_triangles(rough, triangles, 40.0) == []


def test_closest_points_of_creases() -> None:
    creases = Creases(of_triangles(*cube(5.0), 40.0))
    turn = random_rotation(0)
    at = np.array([[2.0, 2.7, 2.3], [3.0, 3.0, 3.0], [0.0, 2.4, 2.6]])
    foot, tangent = creases.closest(at @ turn.T)
    exact = np.array([[2.0, 2.5, 2.5], [2.5, 2.5, 2.5], [0.0, 2.5, 2.5]])
    assert np.allclose(foot @ turn, exact, atol=1e-9)
    assert np.allclose(np.abs(tangent[[0, 2]] @ turn), [[1, 0, 0], [1, 0, 0]], atol=1e-9)


def test_closest_points_of_a_short_crease() -> None:
    for end in (0.05, 0.15):  # stood for by one point, by two
        short = Creases([Chain(np.array([[0.0, 0.0, 0.0], [end, 0.0, 0.0]]), False)])
        foot, tangent = short.closest(np.array([[1.0, 1.0, 0.0], [0.01, 1.0, 0.0]]))
        assert np.allclose(foot, [[end, 0, 0], [0.01, 0, 0]])
        assert np.allclose(tangent, [[1, 0, 0], [1, 0, 0]])


def test_dual_contouring_keeps_edges_and_corners() -> None:
    source = identify("max(abs(x), abs(y), abs(z)) - 1").open()
    frame = ModelFrame(np.full(3, -1.0), 0.2)
    vertices, triangles = contoured(source, frame)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1000, rel=1e-6)  # outward, and every corner is there
    chains = of_triangles(vertices, triangles, 40.0)
    assert len(chains) == 12
    at = frame.input_from_model(np.concatenate([chain.points for chain in chains]))
    # On an edge of the cube two coordinates are 1.
    assert np.abs(np.sort(np.abs(at), axis=1)[:, 1:] - 1).max() < 1e-6


def whole(mesh: Sized) -> None:
    """Creases are chains: two edges at each of their vertices, three at a cube's corners."""
    degree = np.bincount(mesh.creases[:, :2].reshape(-1), minlength=len(mesh.vertices))
    assert (degree[mesh.rank == CREASE] == 2).all()
    assert (degree[mesh.rank == CORNER] == 3).all()
    assert (mesh.rank == CORNER).sum() == 8
    table = EdgeTable.of(mesh.triangles)
    assert mesh.on_crease(table.ends).sum() == len(mesh.creases)


def test_edges_follow_creases_through_remeshing(tmp_path: Path) -> None:
    vertices, triangles = cube(6.0, 1)
    creases = Creases(of_triangles(vertices, triangles, 40.0))
    surface = surface_of(tmp_path / "cube.ply", (vertices, triangles))
    rounded = vertices * (3.0 / np.linalg.norm(vertices, axis=1) * 0.15 + 0.85)[:, None]
    mesh = Sized(rounded, triangles, np.full(len(rounded), 0.7))
    assert remesh(mesh, lambda at: np.full(len(at), 0.7), surface, creases) == 0
    whole(mesh)
    found = deviation(creases, mesh.vertices, mesh.rank, mesh.creases)
    assert found["edge_distance_max"] < 1e-9
    assert found["distance_to_edges_p99"] < 0.05
    volume = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).volume
    assert volume == pytest.approx(216, rel=1e-4)
    for length in (0.35, 1.2):
        mesh.length = np.full(len(mesh.vertices), length)
        split_long(mesh)
        contract_short(mesh)
        flip(mesh, delaunay_gain)
        whole(mesh)


def test_creases_close_to_each_other_stay_apart(tmp_path: Path) -> None:
    box = trimesh.creation.box((6.0, 6.0, 0.5)).subdivide().subdivide().subdivide()
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces, np.int64)
    creases = Creases(of_triangles(vertices, triangles, 40.0))
    surface = surface_of(tmp_path / "plate.ply", (vertices, triangles))
    mesh = Sized(vertices.copy(), triangles.copy(), np.full(len(vertices), 0.6))
    # The corners are nearer to each other than an edge is long.
    assert remesh(mesh, lambda at: np.full(len(at), 0.6), surface, creases) <= 4
    _, area = triangle_normals(mesh.vertices, mesh.triangles)
    assert area.min() > 1e-3
    number = mesh.chains()
    for chain in np.unique(mesh.creases[:, 2]):
        own = Creases([creases.chains[chain]])
        on = mesh.vertices[(number == chain) & (mesh.rank == CREASE)]
        assert np.linalg.norm(on - own.closest(on)[0], axis=1).max(initial=0) < 1e-9


def test_a_crease_around_a_triangle_goes_along_its_third_edge() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    triangles = np.asarray(box.faces, np.int64)
    a, b, c = triangles[0]
    mesh = Sized(np.asarray(box.vertices), triangles, np.full(8, 0.5))
    mesh.rank = np.zeros(8, np.int64)
    mesh.rank[[a, b, c]] = CORNER, CREASE, CORNER
    mesh.creases = np.array([[a, b, 5], [b, c, 5]])
    assert cut_ears(mesh) == 0  # too high for an ear
    mesh.length = np.full(8, 4.0)
    assert cut_ears(mesh) == 1
    assert sorted(mesh.creases[0, :2].tolist()) == sorted([int(a), int(c)])
    assert mesh.creases[:, 2].tolist() == [5]
    assert mesh.rank[b] == 0
    assert cut_ears(mesh) == 0


def test_a_flat_triangle_between_creases_gives_them_up() -> None:
    vertices, triangles = cube(6.0)
    creases = Creases(of_triangles(vertices, triangles, 40.0))
    mesh = Sized(vertices.copy(), triangles, np.full(len(vertices), 0.7))
    assert embed(mesh, creases) == 0
    assert give_up_flat(mesh) == 0
    before = len(mesh.creases)
    # An edge on a crease, and the corner opposite drawn onto it.
    side = next(
        np.roll(one, -k) for one in mesh.triangles for k in range(3)
        if mesh.on_crease(np.roll(one, -k)[None, :2])[0] and mesh.rank[np.roll(one, -k)[2]] == 0
        and (mesh.rank[np.roll(one, -k)[:2]] == CREASE).all()
    )  # fmt: skip
    mesh.vertices[side[2]] = mesh.vertices[side[:2]].mean(axis=0)
    mesh.rank[side[2]] = CREASE
    assert give_up_flat(mesh) >= 1
    assert len(mesh.creases) < before
    assert (mesh.rank[side] == 0).all()
    degree = np.bincount(mesh.creases[:, :2].reshape(-1), minlength=len(mesh.vertices))
    assert (degree[mesh.rank == CREASE] > 0).all()


def test_a_crease_that_no_edges_can_follow_is_counted() -> None:
    vertices, triangles = sphere_mesh(3.0, 3)
    mesh = Sized(vertices, triangles, np.full(len(vertices), 0.3))
    far = Creases(of_triangles(*cube(9.0), 40.0))
    assert embed(mesh, far) == 12
    assert len(mesh.creases) == 0
    assert (mesh.rank == 0).all()


@pytest.mark.parametrize("words", [(), ("--sharp", "off")])
def test_trained_triangles_keep_to_creases(
    words: tuple[str, ...], tmp_path: Path, cli: Cli
) -> None:
    vertices, triangles = cube(2.0, 2)
    write_obj(tmp_path / "cube.obj", vertices, triangles)
    start = ["run", "cube.obj", "-n", 8, "--init-iterations", 10, "--until", "sphere-train"]
    done = cli(*start, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "cube.vorolight" / "sphere-train.json").read_text())["metrics"]
    assert record["certificate"]["holds"]
    if words:
        assert "creases" not in record
        return
    found = record["creases"]
    assert (found["chains"], found["missed"], found["corners"]) == (12, 0, 8)
    assert found["edge_distance_max"] < 0.02
    mesh = trimesh.load(tmp_path / "cube.vorolight" / "sphere-train.ply", process=False)
    assert mesh.volume == pytest.approx(8, rel=1e-4)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--sharp", "soft"], "must be auto, off, or from 5 to 175 degrees"),
        (["--sharp", "200"], "from 5 to 175 degrees"),
        (["--sharp", "30", "--preset", "paper"], "--preset paper does not follow creases"),
    ],
)
def test_impossible_options_are_refused(
    words: list[str], reason: str, tmp_path: Path, cli: Cli
) -> None:
    done = cli("sphere-train", *words, "--run", "run", cwd=tmp_path)
    assert done.returncode == 2
    assert reason in done.stderr


def test_creases_that_are_given_up_are_counted() -> None:
    line = Chain(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), False)
    corners = np.concatenate([line.points, [[0, 1, 0], [0, 0, 1]]])
    whole = np.array([[0, 1, 0], [1, 2, 0], [2, 3, 0]])
    triangles = np.array([[0, 4, 1]])
    ones = np.ones(len(corners))

    def given_up(edges: np.ndarray, missed: int) -> Trained:
        spheres = Spheres(corners, ones, triangles, ones, ones, ones, 0 * whole[:, 0], edges, ones)
        return Trained(spheres, np.zeros((0, 4)), 0, False, Creases([line]), missed, None, None)

    assert given_up(whole, 0).given_up == 0
    assert given_up(whole[1:], 0).given_up == 1
    assert any("in part only" in said for said in given_up(whole[:0], 0).warnings())
    assert given_up(whole[:0], 1).given_up == 0
