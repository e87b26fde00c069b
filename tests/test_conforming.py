"""Triangle faces: remeshing, closest points, mirrored generators, closed-form pairs, duals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Cli, random_rotation, sphere_mesh, torus_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.losses import conforming
from vorolight.stages.sources.fields import FieldSource
from vorolight.stages.sources.mesh import MeshSource
from vorolight.stages.sources.parity import RayParity
from vorolight.stages.sources.projection import ClosestPoint, closest_on_triangles
from vorolight.stages.sources.true_surface import true_surface
from vorolight.stages.surface import geometry
from vorolight.stages.surface.dual import dual
from vorolight.stages.surface.edge_table import EdgeTable
from vorolight.stages.surface.model_frame import ModelFrame
from vorolight.stages.surface.polygons import PolygonMesh
from vorolight.stages.surface.remesh import remesh
from vorolight.stages.surface.sizing import LengthField, thickness
from vorolight.stages.surface.topology import split_pinched, topology
from vorolight.stages.voronoi.interface import interface
from vorolight.stages.voronoi.mirror import mirrored


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    import trimesh

    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    return path


@given(st.integers(0, 10**6))
def test_closest_points_of_a_triangle_are_no_further_than_any_of_its_points(seed: int) -> None:
    random = np.random.default_rng(seed)
    corners, points = random.normal(size=(20, 3, 3)), random.normal(size=(20, 3))
    found = closest_on_triangles(points, corners)
    weight = random.dirichlet(np.ones(3), size=(200,))
    inside = np.einsum("kc,ncd->nkd", weight, corners)
    best = np.linalg.norm(inside - points[:, None], axis=2).min(axis=1)
    assert (np.linalg.norm(found - points, axis=1) <= best + 1e-12).all()
    again = closest_on_triangles(found, corners)
    assert again == pytest.approx(found, abs=1e-9)


def test_closest_points_keep_to_the_side_that_is_asked_for() -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    # Two spheres a hundredth apart, the inner one facing inward: a thin shell.
    both = np.concatenate([vertices, 0.99 * vertices])
    shell = np.concatenate([triangles, len(vertices) + triangles[:, ::-1]])
    closest = ClosestPoint(both, shell, 0.15)
    points = 1.001 * vertices
    inner, _ = closest(points, -vertices)
    outer, _ = closest(points, vertices)
    # The triangles of a level 3 icosphere lie up to 0.006 inside it.
    assert np.linalg.norm(inner, axis=1) == pytest.approx(0.987, abs=0.004)
    assert np.linalg.norm(outer, axis=1) == pytest.approx(0.998, abs=0.004)


def test_winding_numbers_of_overlapping_balls() -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([vertices, 0.5 * vertices + [0.8, 0, 0]])
    rays = RayParity(both, np.concatenate([triangles, triangles + len(vertices)]))
    points = np.array([[0, 0, 0], [0.7, 0, 0], [1.2, 0, 0], [0, 0, 1.5]], float)
    assert rays.winding(points).tolist() == [1, 2, 1, 0]


def test_parts_buried_in_a_mesh_are_no_surface(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([vertices, 0.5 * vertices + [0.8, 0, 0]])
    path = write_ply(tmp_path / "two.ply", both, np.concatenate([triangles, triangles + 642]))
    surface = true_surface(MeshSource(path), ModelFrame(np.zeros(3), 0.1), 2)
    far = 0.1 * np.linalg.norm(surface.samples, axis=1)
    in_small = np.linalg.norm(0.1 * surface.samples - [0.8, 0, 0], axis=1)
    assert (far > 0.98).all()
    assert (in_small > 0.48).all()


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_closest_points_of_a_field(name: str) -> None:
    source = FieldSource(name)
    frame = ModelFrame(np.array([0.1, -0.2, 0.3]), 0.1)
    surface = true_surface(source, frame, 1)
    points = surface.samples[:500] + np.random.default_rng(0).normal(size=(500, 3)) * 0.7
    found, normal = surface.closest(points)
    assert source.value(frame.input_from_model(found)) == pytest.approx(0, abs=1e-8)
    # Both are signed distances, so the way to the surface is as long as their value.
    length = np.linalg.norm(points - found, axis=1) * frame.spacing
    assert length == pytest.approx(np.abs(source.value(frame.input_from_model(points))), abs=1e-5)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1)


@pytest.mark.parametrize("mesh", [sphere_mesh(3.0, 4), torus_mesh(4.0, 1.5, 90, 20)])
def test_remeshing_keeps_the_topology_and_evens_the_edges(mesh: tuple) -> None:
    vertices, triangles = mesh
    closest = ClosestPoint(vertices, triangles, 0.15)
    found, faces, length = remesh(
        vertices, triangles, lambda at: np.full(len(at), 0.6), lambda at, n: closest(at, n)[0]
    )
    before = topology(PolygonMesh.of_triangles(vertices, triangles))
    after = topology(PolygonMesh.of_triangles(found, faces))
    assert (after.closed, after.pinched_vertices) == (True, 0)
    assert after.euler_number == before.euler_number
    ratio = EdgeTable.of(faces).lengths(found) / length[0]
    assert np.percentile(ratio, 1) > 0.7
    assert np.percentile(ratio, 99) < 1.4
    assert geometry.enclosed_volume(found, faces) == pytest.approx(
        geometry.enclosed_volume(vertices, triangles), rel=0.04
    )


def test_remeshing_refuses_an_open_surface() -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    with pytest.raises(ValueError, match="not closed"):
        remesh(vertices, triangles[1:], lambda at: np.full(len(at), 0.3), lambda at, n: at)


def test_thickness_of_a_shell_and_of_a_ball() -> None:
    vertices, _ = sphere_mesh(1.0, 4)
    shell = np.concatenate([vertices, 0.8 * vertices])
    normals = np.concatenate([vertices, -vertices])
    # Samples are about 0.07 apart, so the nearest opposite one may be that much aside.
    assert thickness(shell, normals, 0.5) == pytest.approx(0.2, abs=0.02)
    assert np.isinf(thickness(vertices, vertices, 1.0)).all()


def test_lengths_grow_gently() -> None:
    points = np.stack([np.linspace(0, 10, 400), np.zeros(400), np.zeros(400)], axis=1)
    wanted = np.where(points[:, 0] < 1, 0.1, 2.0)
    field = LengthField(points, wanted)
    assert (field.lengths <= wanted).all()
    assert np.abs(np.diff(field.lengths)).max() < 0.36 * 10 / 399
    assert field(np.array([[9.0, 0, 0]])) == pytest.approx(2.0)


def test_mirrored_generators_make_a_shell_that_its_voxels_cannot(tmp_path: Path) -> None:
    outer, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([outer, 0.94 * outer])
    path = write_ply(
        tmp_path / "shell.ply", both, np.concatenate([triangles, len(outer) + triangles[:, ::-1]])
    )
    source = MeshSource(path)
    frame = ModelFrame(np.full(3, -1.5), 0.1)  # walls of 0.6 voxels
    surface = true_surface(source, frame, 2)
    cells = np.stack(np.meshgrid(*3 * [np.arange(30)], indexing="ij"), axis=-1) + 0.5
    radius = np.linalg.norm(cells * 0.1 - 1.5, axis=-1)
    interior = (radius > 0.9) & (radius < 1.04)
    generators, inside = mirrored(surface, interior, 2, np.random.default_rng(0))
    found = topology(interface(generators, inside).mesh)
    assert (found.euler_number, found.components) == (4, 2) == source.topology()


def test_pairs_lie_on_the_three_spheres_of_their_face() -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    radii = 0.28 + 0.02 * np.sin(5 * vertices[:, 0])
    centres = torch.as_tensor(vertices)
    pairs = conforming.radical_pairs(centres, torch.as_tensor(radii), torch.as_tensor(triangles))
    points = pairs.points(torch.zeros(len(triangles), dtype=torch.float64)).numpy()
    for side in (points[: len(triangles)], points[len(triangles) :]):
        reach = np.linalg.norm(side[:, None] - vertices[triangles], axis=2)
        assert reach == pytest.approx(radii[triangles], abs=1e-12)
    assert (np.linalg.norm(points[: len(triangles)], axis=1) > 1).all()


@pytest.mark.parametrize("term", ["existence", "exclusion", "umbrella", "square"])
def test_gradients_against_finite_differences(term: str) -> None:
    vertices, triangles = sphere_mesh(1.0, 1)
    random = np.random.default_rng(0)
    centres = torch.tensor(vertices + 0.02 * random.normal(size=vertices.shape), requires_grad=True)
    radii = torch.tensor(0.45 + 0.02 * random.random(len(vertices)), requires_grad=True)
    faces = torch.as_tensor(triangles)
    table = EdgeTable.of(triangles)
    ends = torch.as_tensor(table.ends)
    degree = torch.bincount(ends.reshape(-1)).double()
    count = len(triangles)
    near = torch.arange(2 * count), torch.arange(2 * count) % len(vertices)

    def value(at: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
        pairs = conforming.radical_pairs(at, size, faces)
        if term == "square":
            return pairs.square
        if term == "existence":
            return conforming.existence(pairs, torch.full((count,), 0.9, dtype=torch.float64))
        if term == "umbrella":
            return conforming.umbrella(at, ends, degree)
        points = pairs.points(torch.full((count,), 1e-4, dtype=torch.float64))
        length = torch.full((len(vertices),), 5.0, dtype=torch.float64)
        return conforming.exclusion(points, at, size, length, *near)

    torch.autograd.gradcheck(value, (centres, radii))


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
    for key in ("holds", "failed", "intruders", "bad_rings", "turned_faces", "wound_wrongly"):
        assert found["certificate"][key] == trained["certificate"][key]
    assert found["certificate"]["margin"] == pytest.approx(trained["certificate"]["margin"])
    assert found["gates"]["certificate"] is True
    # Walls of the volume and faces of the surface are the same.
    assert result(heart_run, "volume")["boundary_faces"] == trained["trained_faces"]


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
            ["evaluate", "--samples", 20000],
        ):
            where = [] if words[0] == "init" else ["--run", f"{name}.vorolight"]
            done = cli(*words, *where, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
    runs = [tmp_path / f"{name}.vorolight" for name in "abc"]
    from vorolight.stages.artifacts.hdf5 import decode

    first, second = (decode(run / "sphere-train.h5", "sphere-train")[0] for run in runs[:2])
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


def test_losses_that_an_input_does_not_have(tmp_path: Path, cli: Cli) -> None:
    assert cli("init", "sphere", "-n", 6, "--iterations", 0, cwd=tmp_path).returncode == 0
    for words, message in (
        (["--shape-loss", "chamfer"], "add --faces polygon"),
        (["--faces", "polygon", "--shape-loss", "chamfer"], "a field has no target points"),
    ):
        done = cli("sphere-train", *words, cwd=tmp_path)
        assert done.returncode == 2
        assert message in done.stderr
