"""Inputs: fields, meshes, ray parity, voxels, reflection."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, random_rotation, sphere_mesh, torus_mesh, write_obj, write_ply
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.artifacts.randomness import generator
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.errors import InputError
from vorolight.stages.inputs import classification
from vorolight.stages.inputs.field.source import FIELDS, FieldSource
from vorolight.stages.inputs.mesh.sheet import thickened
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.inputs.thin import thin_parts
from vorolight.stages.mesh import voxels
from vorolight.stages.mesh.geometry import enclosed_volume
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.queries.parity import RayParity
from vorolight.stages.mesh.voxels import VoxelGrid
from vorolight.stages.voronoi.diagram.interface import interface
from vorolight.stages.voronoi.start.reflection import reflect


def classified(source: object, n: int) -> voxels.VoxelGrid:
    return classification.classify(source, n, lambda name, i: generator(0, "test", name, i))


@given(st.integers(0, 10**6))
def test_parity_is_the_inside_of_a_torus_however_it_is_turned(seed: int) -> None:
    vertices, triangles = torus_mesh(1.0, 0.4, 48, 24)
    turn = random_rotation(seed)
    points = np.random.default_rng(seed).uniform(-1.5, 1.5, (2000, 3))
    tube = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1, points[:, 2])
    clear = np.abs(tube - 0.4) > 0.01  # the mesh lies within its chord's height of the torus
    inside = RayParity(vertices @ turn.T, triangles, seed % 3).inside(points @ turn.T)
    assert np.array_equal(inside[clear], (tube < 0.4)[clear])


def test_parity_on_a_lattice_through_the_edges_of_a_cube(tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    source = MeshSource(write_obj(tmp_path / "cube.obj", corners, quads))
    assert source.polygons.valences.tolist() == [4] * 6
    assert source.loaded.polygons_kept
    assert source.median_edge_length() == 1
    axis = np.linspace(-0.5, 1.5, 9)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    boundary = np.isclose(points, 0) | np.isclose(points, 1)
    clear = ~boundary.any(axis=1)
    expected = ((points > 0) & (points < 1)).all(axis=1)
    assert np.array_equal(source.inside(points)[clear], expected[clear])


def test_parity_of_nested_spheres_and_no_triangles() -> None:
    outer, faces = sphere_mesh(1.0)
    inner, _ = sphere_mesh(0.5)
    both = RayParity(np.concatenate([outer, inner]), np.concatenate([faces, faces + len(outer)]))
    assert both.inside(np.array([[0, 0, 0], [0.7, 0, 0], [2, 0, 0]])).tolist() == [0, 1, 0]
    nothing = RayParity(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert not nothing.inside(np.zeros((3, 3))).any()


def cut_sphere(path: Path, turned: int = 0, doubled: int = 0) -> MeshSource:
    """A unit sphere without its cap above z = 0.8, where a wavy edge keeps it from being closed by
    a flat one, with triangles turned over or there twice."""
    vertices, triangles = sphere_mesh()
    x, y, z = vertices[triangles].mean(axis=1).T
    triangles = triangles[z < 0.8 + 0.13 * np.cos(2 * np.arctan2(y, x))]
    triangles = np.concatenate([triangles, triangles[:doubled]])
    triangles[:turned] = triangles[:turned, ::-1]
    return MeshSource(write_obj(path, vertices, triangles))


@pytest.mark.parametrize(("turned", "doubled"), [(0, 0), (300, 0), (0, 200), (100, 200)])
def test_inside_of_an_open_mesh(tmp_path: Path, turned: int, doubled: int) -> None:
    source = cut_sphere(tmp_path / "cut.obj", turned, doubled)
    assert source.open_edges > 0
    # Of triangles that are there twice and differently turned either may be the one that counts.
    assert source.winding.turned in ((turned,) if not doubled else (0, turned))
    assert source.winding.doubled == doubled
    assert "not closed" in source.warnings()[0]
    assert ("doubled faces count once" in source.warnings()[0]) == (doubled > 0)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (4000, 3))
    radius = np.linalg.norm(points, axis=1)
    # The mesh's own thickness of facets aside, and the hole's neighbourhood.
    clear = (np.abs(radius - 1) > 0.03) & (np.hypot(radius - 0.9, points[:, 2] - 0.8) > 0.35)
    clear &= points[:, 2] < 0.7
    assert np.array_equal(source.inside(points[clear]), radius[clear] < 1)
    assert 0.8 < source.sureness < 1
    low = source.bounding_box()[0]
    shape = (12, 12, 12)
    met = source.may_cross(low - 0.3, 0.2, shape)
    corner = np.array(np.unravel_index(np.flatnonzero(~met), shape)).T
    inside = [
        source.inside(low - 0.3 + 0.2 * (corner + np.random.default_rng(k).random(corner.shape)))
        for k in range(4)
    ]
    assert all(np.array_equal(inside[0], other) for other in inside)


def test_a_hole_is_spanned(tmp_path: Path) -> None:
    source = cut_sphere(tmp_path / "cut.obj")
    surface = source.true_surface(ModelFrame(np.zeros(3), 0.1), threads=2)
    # A disc of radius 0.6 closes it at z = 0.8; the level of a half bulges out of it a little.
    foot, normal = surface.closest(np.array([[0.0, 0.0, 20.0], [2.0, 1.0, 11.0]]))
    assert ((foot[:, 2] > 7.5) & (foot[:, 2] < 10)).all()
    assert (normal[:, 2] > 0.8).all()
    across = np.hypot(*surface.samples[:, :2].T)
    share = ((surface.samples[:, 2] > 7.2) & (across < 4)).mean()
    # Of the sphere that is left, 3.6 pi in size, 0.16 pi.
    assert share == pytest.approx(0.16 / 3.8, rel=0.3)


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_fields(name: str) -> None:
    source = FieldSource(name)
    low, high = source.bounding_box()
    points = source.surface_samples(3000, np.random.default_rng(0))
    assert np.abs(source.value(points)).max() < 1e-9
    assert ((points > low) & (points < high)).all()
    assert np.linalg.norm(points, axis=1).max() < FIELDS[name].radius
    import torch

    assert np.allclose(source.level(torch.tensor(points)).numpy(), source.value(points))


def test_field_samples_are_uniform_by_area() -> None:
    points = FieldSource("sphere").surface_samples(20_000, np.random.default_rng(1))
    # Archimedes: the height of a uniform point on a sphere is uniform.
    share = (points[:, 2] > 0.5).mean()
    assert share == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 20_000))
    assert np.allclose(FieldSource("sphere").mean_curvature(points), 1)


def test_classified_sphere_has_its_volume_and_band() -> None:
    grid = classified(FieldSource("sphere"), 24)
    interior = grid.interior.sum() * grid.spacing**3
    # "Any of 35 samples" adds about half a voxel all around.
    assert 4 / 3 * np.pi < interior < 4 / 3 * np.pi * (1 + grid.spacing) ** 3
    assert not (grid.interior & grid.exterior).any()
    again = classified(FieldSource("sphere"), 24)
    assert np.array_equal(grid.interior, again.interior)


def test_classify_refuses_what_has_no_inside(tmp_path: Path) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0.3], [0.2, 1, 0.7]])
    source = MeshSource(write_obj(tmp_path / "leaf.obj", vertices, [[0, 1, 2], [2, 1, 0]]))
    with pytest.raises(InputError, match="no sample lies inside"):
        classified(source, 8)


def test_reflected_generators_make_a_closed_surface_near_the_shape() -> None:
    source = FieldSource("torus")
    grid = classified(source, 24)
    generators, inside = reflect(grid)
    surface = interface(generators, inside)
    from vorolight.stages.mesh.topology import topology

    facts = topology(surface.mesh)
    assert facts.closed
    assert facts.euler_number == 0
    assert np.unique(surface.generators).size == len(generators)
    assert np.abs(source.value(surface.mesh.vertices)).max() < 2 * grid.spacing


def test_cells_without_surface_are_in_or_out(tmp_path: Path) -> None:
    vertices, triangles = torus_mesh(1.0, 0.4, 24, 12)
    source = MeshSource(write_ply(tmp_path / "torus.ply", vertices, triangles))
    origin, edge, shape = np.array([-1.6, -1.5, -0.6]), 0.09, (35, 34, 13)
    crossed = source.may_cross(origin, edge, shape)
    index = np.argwhere(~crossed)
    random = np.random.default_rng(0)
    samples = [source.inside(origin + edge * (index + random.random(index.shape))) for _ in "12345"]
    assert all(np.array_equal(samples[0], sample) for sample in samples)
    # Both kinds are there, and not too much is taken for crossed.
    assert 0 < samples[0].sum() < len(index)
    assert crossed.mean() < 0.6
    opened = MeshSource(write_ply(tmp_path / "open.ply", vertices, triangles[1:]))
    # Beside the hole the inside ends without a triangle.
    assert (opened.may_cross(origin, edge, shape) >= crossed).all()


def test_repair_closes_and_is_said(tmp_path: Path) -> None:
    source = cut_sphere(tmp_path / "a.obj", turned=100, doubled=50)
    before = source.path.read_bytes()
    assert source.open_edges > 0
    mended = MeshSource(source.path)
    mended.repair = True
    assert mended.open_edges == 0
    assert mended.topology() == (2, 1)
    assert "the mesh was repaired" in mended.warnings()[0]
    assert source.path.read_bytes() == before
    again = MeshSource(source.path)
    again.restore(mended.state())
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (2000, 3))
    assert np.array_equal(again.inside(points), mended.inside(points))


def test_repair_fails_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vorolight.stages import child

    source = MeshSource(write_ply(tmp_path / "a.ply", *sphere_mesh()))
    source.repair = True
    monkeypatch.setattr(child.sys, "executable", "false")
    with pytest.raises(InputError, match=r"a\.ply: --repair by pymeshlab failed"):
        source.polygons  # noqa: B018


def test_thin_parts_are_measured(tmp_path: Path) -> None:
    import trimesh

    solid = trimesh.util.concatenate(
        [
            trimesh.creation.box((2, 2, 1)),
            # A plate of a tenth of a voxel, and a rod of half a voxel.
            trimesh.creation.box((2, 2, 0.02)).apply_translation([0, 0, 2]),
            trimesh.creation.box((2, 0.1, 0.1)).apply_translation([0, 0, 3]),
        ]
    )
    solid.export(tmp_path / "a.ply")
    source = MeshSource(tmp_path / "a.ply")
    grid = classified(source, 18)  # of 4 / 18 = 0.2 or so
    found = thin_parts(source, grid, 2)
    plate, rod, box = 2 * 4 + 8 * 0.02, 4 * 2 * 0.1 + 0.02, 2 * 4 + 8.0
    assert found.too_thin == pytest.approx((plate - 0.16) / (plate + rod + box), abs=0.03)
    assert found.share == pytest.approx((plate - 0.16 + rod) / (plate + rod + box), abs=0.03)
    assert found.lost < 0.01  # thirty-five samples hit a tenth of a voxel almost surely
    assert "thinner than 0.2 voxels" in str(found.warning())
    empty = VoxelGrid(grid.origin, grid.spacing, np.zeros_like(grid.interior), grid.exterior)
    assert thin_parts(source, empty, 2).lost == 1


def test_a_mesh_that_encloses_nothing_is_a_sheet(tmp_path: Path) -> None:
    square = write_obj(
        tmp_path / "square.obj",
        np.array([[0, 0, 5], [2, 0, 5], [2, 1, 5], [0, 1, 5.0]]),
        [[0, 1, 2, 3]],
    )
    source = MeshSource(square)
    assert source.flat
    source.take_as_sheet(0.2)
    assert source.topology() == (2, 1)
    # A plate, half cylinders along its sides and a sphere in all at its corners.
    volume = 2 * 1 * 0.2 + 0.5 * np.pi * 0.1**2 * 6 + 4 / 3 * np.pi * 0.1**3
    found = np.abs(source.inside(np.array([[1, 0.5, 5.09], [1, 0.5, 5.11], [-0.09, 0.5, 5]])))
    assert found.tolist() == [True, False, True]
    # Marching cubes cuts off the round rims.
    assert enclosed_volume(source.vertices, source.triangles) == pytest.approx(volume, rel=0.03)
    assert "4 edges are not in two faces" in source.warnings()[0]
    again = MeshSource(square)
    again.restore(source.state())
    assert np.array_equal(again.vertices, source.vertices)
    with pytest.raises(InputError, match="too thin"):
        thickened(source.loaded.polygons, 1e-6, "square")


def test_a_soup_of_triangles_is_refused(tmp_path: Path, cli: Cli) -> None:
    random = np.random.default_rng(0)
    corners = random.random((100, 1, 3)) + 0.3 * random.normal(size=(100, 3, 3))
    faces = np.arange(300).reshape(-1, 3)
    write_obj(tmp_path / "soup.obj", corners.reshape(-1, 3), faces)
    done = cli("run", "soup.obj", "-n", 8, cwd=tmp_path)
    assert done.returncode == 3
    assert "300 of 300 edges are not in two faces" in done.stderr
    done = cli("classify", "soup.obj", "-n", 8, "--allow-poor-input", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # Triangles apart from each other may enclose a solid all the same.
    vertices, triangles = sphere_mesh(1.0, 3)
    apart = vertices[triangles]
    apart = apart.mean(axis=1, keepdims=True) + 0.999 * (apart - apart.mean(axis=1, keepdims=True))
    faces = np.arange(apart.size // 3).reshape(-1, 3)
    MeshSource(write_obj(tmp_path / "apart.obj", apart.reshape(-1, 3), faces)).refuse_soup()


def test_an_open_cap_becomes_a_sheet_of_one_voxel(tmp_path: Path, cli: Cli) -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    above = (vertices[triangles].mean(axis=1)[:, 2] > 0.6).nonzero()[0]
    write_obj(tmp_path / "cap.obj", vertices, triangles[above])
    done = cli("classify", "cap.obj", "-n", "16", cwd=tmp_path)
    assert done.returncode == 0
    folder = RunFolder(tmp_path / "cap.vorolight")
    stored = folder.manifest("classify")
    used = vertices[np.unique(triangles[above])]
    assert stored["metrics"]["input"]["thickness"] == pytest.approx(np.ptp(used[:, 0]) / 16)
    assert "is made a sheet" in done.stderr


def test_memory_is_checked_before_a_mesh_is_examined(tmp_path: Path, cli: Cli) -> None:
    corners = np.random.default_rng(0).random((300, 3))
    write_obj(tmp_path / "soup.obj", corners, np.arange(300).reshape(-1, 3))
    # That the mesh is no solid takes long to find out.
    done = cli("classify", "soup.obj", "--max-memory", "0.1", cwd=tmp_path)
    assert done.returncode == 2
    assert "--max-memory allows 0.1 GB" in done.stderr
    done = cli("classify", "soup.obj", cwd=tmp_path)
    assert done.returncode == 3
    assert "is not the surface of a solid" in done.stderr
