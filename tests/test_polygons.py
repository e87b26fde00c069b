"""Exact polygons: what is merged, the equations of their corners, and certified runs."""

from __future__ import annotations

import json
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

from vorolight.stages.mesh.edge_table import EdgeTable, Sized
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import edges, topology
from vorolight.stages.remesh.plane_parts import plane_parts
from vorolight.stages.remesh.stars import KEPT, KEPT_FLAT, Rings, groups, merged
from vorolight.stages.training.agreement import Polygons, agreeing
from vorolight.stages.training.polygon_problem import (
    Corners,
    Planes,
    PolygonProblem,
    incidence,
    incidence_gradient,
)
from vorolight.stages.training.spheres import Spheres


def merging(
    vertices: np.ndarray, triangles: np.ndarray, flat: bool = False, most: float = 1.0
) -> PolygonMesh:
    count, table = len(vertices), EdgeTable.of(triangles)
    group = groups(
        vertices, triangles, np.zeros(count, np.int64), np.zeros(len(table.ends), bool),
        np.full(count, flat), most,
    )  # fmt: skip
    return merged(vertices, triangles, group)[0].without_unused_vertices()


def area_share(mesh: PolygonMesh) -> float:
    from vorolight.stages.mesh.geometry import face_frames

    area = face_frames(mesh)[0]
    return float(area[mesh.valences > 3].sum() / area.sum())


def test_rings_go_once_around() -> None:
    vertices, triangles = torus_mesh(1.0, 0.4, 12, 8)
    rings = Rings.of(triangles, len(vertices))
    assert rings.degrees.sum() == 3 * len(triangles)
    for vertex in (0, 17, 95):
        own = slice(rings.offsets[vertex], rings.offsets[vertex + 1])
        ring, faces = rings.vertices[own], rings.triangles[own]
        for place, face in enumerate(faces):
            corners = {vertex, ring[place], ring[(place + 1) % len(ring)]}
            assert set(triangles[face].tolist()) == corners


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("mesh", [sphere_mesh(1.0, 4), torus_mesh(1.0, 0.4, 60, 30)])
def test_merging_keeps_the_topology_and_enough_edges(mesh: tuple, flat: bool) -> None:
    before = topology(PolygonMesh.of_triangles(*mesh))
    found = merging(*mesh, flat=flat)
    after = topology(found)
    assert after.closed
    assert after.pinched_vertices == 0
    assert (after.euler_number, after.components) == (before.euler_number, before.components)
    assert np.bincount(edges(found).reshape(-1)).min() >= (KEPT_FLAT if flat else KEPT)
    assert area_share(found) > 0.6
    assert after.faces < 0.55 * before.faces


def test_the_share_of_polygons_is_a_bound() -> None:
    mesh = sphere_mesh(1.0, 4)
    assert area_share(merging(*mesh, most=0.0)) == 0
    assert 0.25 < area_share(merging(*mesh, most=0.3)) <= 0.3


def test_groups_without_one_ring_are_refused() -> None:
    vertices, triangles = torus_mesh(1.0, 0.4, 12, 8)
    # A band around the tube has two rings.
    band = np.arange(len(triangles))
    band[np.isin(triangles, np.arange(8)).any(axis=1)] = 0
    with pytest.raises(ValueError, match=r"one ring|twice"):
        merged(vertices, triangles, band)


def test_plane_parts_of_a_box_and_of_a_cylinder(tmp_path: Path) -> None:
    box = trimesh.creation.box((6.0, 5.0, 4.0)).subdivide_to_size(0.9)
    box.merge_vertices()
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces, np.int64)
    turn = random_rotation(0)
    table = EdgeTable.of(triangles)
    on_side = np.abs(vertices) >= [3 - 1e-9, 2.5 - 1e-9, 2 - 1e-9]
    crease = table.ends[on_side[table.ends].all(axis=1).sum(axis=1) == 2]
    mesh = Sized(
        vertices @ turn.T, triangles, np.ones(len(vertices)),
        creases=np.column_stack([crease, np.zeros(len(crease), np.int64)]),
    )  # fmt: skip
    surface = surface_of(tmp_path / "box.ply", (vertices @ turn.T, triangles))
    found = plane_parts(mesh, table, surface, np.full(len(triangles), 0.5))
    assert len(np.unique(found.part)) == 6
    assert found.part.min() >= 0
    heights = np.einsum("tkj,tj->tk", mesh.vertices[triangles], found.normal[found.part])
    assert heights == pytest.approx(
        np.repeat(found.offset[found.part][:, None], 3, axis=1), abs=1e-6
    )
    rounded = sphere_mesh(3.0, 3)
    surface = surface_of(tmp_path / "ball.ply", rounded)
    mesh = Sized(*rounded, np.ones(len(rounded[0])))
    found = plane_parts(mesh, EdgeTable.of(rounded[1]), surface, np.full(len(rounded[1]), 0.4))
    assert (found.part == -1).all()


def polygons_of(
    mesh: PolygonMesh, random: np.random.Generator, noise: float, radius: float = 1.2
) -> Polygons:
    """Polygons with spheres that nearly agree."""
    corners = Corners.of(mesh, np.zeros(mesh.face_count, bool))
    count = mesh.vertex_count
    start, end = edges(mesh).T
    length = np.full(
        count, np.linalg.norm(mesh.vertices[start] - mesh.vertices[end], axis=1).mean()
    )
    ones = np.ones(count)
    spheres = Spheres(
        mesh.vertices + noise * length[0] * random.normal(size=(count, 3)),
        length * (radius + noise * random.normal(size=count)), corners.defining, length, ones,
        0 * ones, np.zeros(count, np.int64), np.zeros((0, 3), np.int64), ones,
    )  # fmt: skip
    none = np.zeros(0, np.int64)
    return Polygons(mesh, corners, Planes(none, np.zeros((0, 3)), np.zeros(0)), spheres)


def test_three_corners_are_no_equation_and_agreement_is_that_of_a_pair() -> None:
    """On a round sphere all spheres of one radius through its centre agree with every ring that is
    plane: the corners of a cube's sides."""
    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    mesh = PolygonMesh(
        np.asarray(cube.vertices), np.arange(7, dtype=np.int64) * 4,
        np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                  [1, 5, 7, 3]], np.int64).reshape(-1),
    )  # fmt: skip
    polygons = polygons_of(mesh, np.random.default_rng(0), 0.0)
    height, power, share, _ = incidence(polygons.spheres, polygons.corners)
    assert len(height) == 6
    assert np.abs([*height, *power]).max() < 1e-12
    assert share.sum(axis=1) == pytest.approx(np.ones(6))


def test_derivatives_of_the_agreement() -> None:
    """By central differences; that of the power is taken where the corner lies in the plane."""
    random = np.random.default_rng(1)
    mesh = merging(*sphere_mesh(1.0, 2))
    free = np.ones(mesh.vertex_count, bool)
    polygons = agreeing(polygons_of(mesh, random, 0.01), free, 1e-13)
    state, corners = polygons.spheres, polygons.corners
    *_, share, pairs = incidence(state, corners)
    columns, *gradients = incidence_gradient(state, corners, share, pairs)
    move = random.normal(size=(len(state.centres), 4))
    step = 1e-6
    sides = []
    for sign in (1, -1):
        moved = replace(
            state,
            centres=state.centres + sign * step * move[:, :3],
            radii=state.radii + sign * step * move[:, 3],
        )
        sides.append(incidence(moved, corners)[:2])
    for number, gradient in enumerate(gradients):
        measured = (sides[0][number] - sides[1][number]) / (2 * step)
        assert (gradient * move.reshape(-1)[columns]).sum(axis=1) == pytest.approx(
            measured, abs=1e-6 * np.abs(measured).max()
        )


def test_derivatives_of_polygons_against_finite_differences(tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "ball.ply", sphere_mesh(1.05, 3))
    random = np.random.default_rng(0)
    mesh = merging(*sphere_mesh(1.0, 2), flat=True)
    free = np.ones(mesh.vertex_count, bool)
    # Corners agree, so that the derivative of their powers is exact; all else is off.
    polygons = agreeing(polygons_of(mesh, random, 0.03, 1.7), free, 1e-13)
    state = polygons.spheres
    vertex = np.arange(3)
    planes = Planes(vertex, np.eye(3), state.centres[vertex].sum(axis=1))
    weights = {"exclusion": 2.0, "shape": 5.0, "smooth": 0.7, "radius": 0.4}
    problem = PolygonProblem(
        mesh, polygons.corners, planes, state, mesh.vertices, 0.9 * state.radii, free, surface,
        None, weights, 1,
    )  # fmt: skip
    problem.offset = np.full(mesh.face_count, 2.0)
    problem.margin = np.full(mesh.vertex_count, 2.0)
    problem.convex = 2.0
    assert_derivatives(problem, state)
    residuals = problem.residuals(state)
    for name in ("offset", "convex", "plane", "shape", "smooth", "radius", "exclusion"):
        assert (residuals[name] != 0).any(), name


def test_steps_of_least_change_agree_to_rounding() -> None:
    mesh = merging(*sphere_mesh(1.0, 3))
    polygons = polygons_of(mesh, np.random.default_rng(0), 0.005)
    free = np.ones(mesh.vertex_count, bool)
    # Twice, as in a training, whose rounds stop before.
    found = agreeing(agreeing(polygons, free, 1e-7), free, 1e-12)
    height, power, *_ = incidence(found.spheres, found.corners)
    assert np.abs([*height, *power]).max() < 1e-9
    assert np.abs(found.spheres.centres - polygons.spheres.centres).max() < 0.1
    # What is not free stays.
    free[:40] = False
    kept = agreeing(polygons, free, 1e-12)
    assert (kept.spheres.centres[:40] == polygons.spheres.centres[:40]).all()


def result(run: Path, stage: str = "sphere-train") -> dict:
    return json.loads((run / f"{stage}.json").read_text())["metrics"]


def assert_exact(run: Path, share: float) -> dict:
    """Certified polygons, whose file other programs read as closed and of the right volume."""
    found = result(run)
    assert found["certificate"]["holds"]
    assert found["polygons"]["share"] > share
    assert sum(found["polygons"]["by_corners"].values()) == found["trained_faces"]
    read = trimesh.load_mesh(run / "sphere-train.ply", process=False)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.euler_number == found["topology"]["euler_number"]
    return found


def test_polygons_of_a_torus(tmp_path: Path, cli: Cli) -> None:
    words = ["-n", 12, "--init-iterations", 3, "--faces", "polygon", "--until", "volume"]
    done = cli("run", "torus", *words, "--inner", 60, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    run = tmp_path / "torus.vorolight"
    found = assert_exact(run, 0.5)
    assert (found["topology"]["euler_number"], found["topology"]["components"]) == (0, 1)
    volume = result(run, "volume")
    assert volume["boundary_faces"] == found["trained_faces"]
    assert volume["volume_error"] < 1e-12
    assert volume["bodies"] == 1
    assert not any(volume["faults"].values())


def test_polygons_of_a_part_with_plane_sides(tmp_path: Path, cli: Cli) -> None:
    """Three edges are enough in a plane: nearly all of it is polygons, and the creases stay."""
    box = trimesh.creation.box((6.0, 5.0, 4.0))
    path = write_ply(tmp_path / "box.ply", box.vertices, box.faces)
    words = ["-n", 10, "--init-iterations", 0, "--faces", "polygon", "--until", "sphere-train"]
    done = cli("run", path, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = assert_exact(tmp_path / "box.vorolight", 0.75)
    assert found["creases"]["missed"] == found["creases"]["given_up"] == 0
    read = trimesh.load_mesh(tmp_path / "box.vorolight" / "sphere-train.ply", process=False)
    # Vertices are drawn to planes and creases by least squares, not put onto them.
    assert read.volume == pytest.approx(120, rel=1e-5)
    bounded = cli(
        "sphere-train", "--run", "box.vorolight", "--faces", "polygon", "--polygon-share", 0.2,
        cwd=tmp_path,
    )  # fmt: skip
    assert bounded.returncode == 0, bounded.stderr
    assert result(tmp_path / "box.vorolight")["polygons"]["share"] <= 0.2
    refused = cli("sphere-train", "--run", "box.vorolight", "--polygon-share", 0.2, cwd=tmp_path)
    assert refused.returncode == 2
    assert "applies to --faces polygon only" in refused.stderr


def test_no_polygon_at_all_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing conforms, the triangles are what is written, not in silence."""
    from vorolight.stages import classify, init, sphere_train
    from vorolight.stages.artifacts.run_folder import RunFolder
    from vorolight.stages.engine import runner
    from vorolight.stages.engine.session import Session
    from vorolight.stages.inputs.resolve import identify
    from vorolight.stages.training import polygons

    monkeypatch.setattr(polygons, "ROUNDS", 1)
    session = Session(RunFolder(tmp_path / "run"), identify("sphere"))
    runner.execute(session, "classify", classify.Params(n_init=6))
    runner.execute(session, "init", init.Params(iterations=0))
    done = runner.execute(session, "sphere-train", sphere_train.Params(faces="polygon"))
    assert any("all faces are triangles" in text for text in done.manifest["warnings"])
    assert done.manifest["metrics"]["certificate"]["holds"]
