"""Closest points, fitted remeshing, thin parts, and the generators mirrored in a surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import sphere_mesh, surface_of, torus_mesh, write_ply
from hypothesis import given
from hypothesis import strategies as st
from manifold3d import Manifold

from vorolight.stages.inputs.field.source import FieldSource
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.mesh import geometry
from vorolight.stages.mesh.edge_table import EdgeTable, Sized
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.queries.intersections import self_intersections
from vorolight.stages.mesh.queries.parity import RayParity
from vorolight.stages.mesh.queries.projection import ClosestPoint, closest_on_triangles
from vorolight.stages.mesh.queries.true_surface import TrueSurface
from vorolight.stages.mesh.topology import topology
from vorolight.stages.remesh.embedding import kept_embedded
from vorolight.stages.remesh.length_field import LengthField, thickness
from vorolight.stages.remesh.operations import split_long
from vorolight.stages.remesh.remeshing import remesh, thin_out
from vorolight.stages.remesh.sheets import draw_back, part
from vorolight.stages.training.repair import rounded
from vorolight.stages.voronoi.diagram.interface import interface
from vorolight.stages.voronoi.start.mirror import mirrored


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
    surface = MeshSource(path).true_surface(ModelFrame(np.zeros(3), 0.1), 2)
    far = 0.1 * np.linalg.norm(surface.samples, axis=1)
    in_small = np.linalg.norm(0.1 * surface.samples - [0.8, 0, 0], axis=1)
    assert (far > 0.98).all()
    assert (in_small > 0.48).all()


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_closest_points_of_a_field(name: str) -> None:
    source = FieldSource(name)
    frame = ModelFrame(np.array([0.1, -0.2, 0.3]), 0.1)
    surface = source.true_surface(frame, 1)
    points = surface.samples[:500] + np.random.default_rng(0).normal(size=(500, 3)) * 0.7
    found, normal = surface.closest(points)
    assert source.value(frame.input_from_model(found)) == pytest.approx(0, abs=1e-8)
    # Both are signed distances, so the way to the surface is as long as their value.
    length = np.linalg.norm(points - found, axis=1) * frame.spacing
    assert length == pytest.approx(np.abs(source.value(frame.input_from_model(points))), abs=1e-5)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1)


def remeshed(
    vertices: np.ndarray, triangles: np.ndarray, length: float, surface: TrueSurface
) -> Sized:
    """With edges of one ``length``."""
    mesh = Sized(vertices.copy(), triangles.copy(), np.full(len(vertices), length))
    remesh(mesh, lambda at: np.full(len(at), length), surface)
    return mesh


@pytest.mark.parametrize("mesh", [sphere_mesh(3.0, 4), torus_mesh(4.0, 1.5, 90, 20)])
def test_remeshing_keeps_the_topology_and_evens_the_edges(mesh: tuple, tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "shape.ply", mesh)
    found = remeshed(*mesh, 0.6, surface)
    before = topology(PolygonMesh.of_triangles(*mesh))
    after = topology(PolygonMesh.of_triangles(found.vertices, found.triangles))
    assert (after.closed, after.pinched_vertices) == (True, 0)
    assert after.euler_number == before.euler_number
    ratio = EdgeTable.of(found.triangles).lengths(found.vertices) / 0.6
    assert np.percentile(ratio, 1) > 0.65
    assert np.percentile(ratio, 99) < 1.45
    # Fitted, not inscribed: the volumes agree much better than edges of 0.6 would inscribe.
    assert geometry.enclosed_volume(found.vertices, found.triangles) == pytest.approx(
        geometry.enclosed_volume(*mesh), rel=0.002
    )


def test_a_fine_input_is_thinned_out_with_its_vertices_in_place() -> None:
    vertices, triangles = torus_mesh(4.0, 1.5, 240, 90)
    mesh = Sized(vertices.copy(), triangles.copy(), np.ones(len(vertices)))
    thin_out(mesh, lambda at: np.full(len(at), 0.6))
    # As many as edges of that length have, which remeshing alone comes to in twelve iterations.
    expected = 4 * np.pi**2 * 4.0 * 1.5 / (np.sqrt(3) / 4 * 0.6**2)
    assert len(mesh.triangles) < 1.5 * expected < 0.1 * len(triangles)
    facts = topology(PolygonMesh.of_triangles(mesh.vertices, mesh.triangles))
    assert (facts.closed, facts.euler_number, facts.pinched_vertices) == (True, 0, 0)
    assert np.isin(mesh.vertices @ [1, 3, 7], vertices @ [1, 3, 7]).all()
    assert len(self_intersections(mesh.vertices, mesh.triangles)) == 0


def test_remeshing_refuses_an_open_surface(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    surface = surface_of(tmp_path / "ball.ply", (vertices, triangles))
    with pytest.raises(ValueError, match="not closed"):
        remeshed(vertices, triangles[1:], 0.3, surface)


def test_a_chamfered_cube_gets_its_edges_back(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.creation.box((4.0, 4.0, 4.0))
    cube = np.asarray(box.vertices, float), np.asarray(box.faces, np.int64)
    surface = surface_of(tmp_path / "cube.ply", cube)
    vertices, triangles = sphere_mesh(1.0, 4)
    rounded = 2 * vertices / (np.abs(vertices) ** 6).sum(axis=1)[:, None] ** (1 / 6)
    found = remeshed(rounded, triangles, 0.6, surface)
    edge = np.linspace(-2, 2, 200)
    edges = np.stack([edge, np.full(200, 2.0), np.full(200, 2.0)], axis=1)
    edges = np.concatenate([edges, edges[:, [1, 0, 2]], edges[:, [1, 2, 0]]])
    own = ClosestPoint(found.vertices, found.triangles, 0.0)
    off = np.linalg.norm(own(edges)[0] - edges, axis=1)
    assert np.percentile(off, 95) < 0.01  # the rounded start is 0.3 off
    assert geometry.enclosed_volume(found.vertices, found.triangles) == pytest.approx(64, rel=2e-3)


def test_closest_points_are_exact(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    vertices = vertices * [5.0, 1.0, 0.1]  # long, thin triangles
    random = np.random.default_rng(0)
    points = random.normal(size=(60, 3)) * [5.0, 1.0, 1.0]
    found, _ = ClosestPoint(vertices, triangles, 0.15)(points)
    best = np.full(len(points), np.inf)
    for corners in vertices[triangles]:
        there = closest_on_triangles(points, np.broadcast_to(corners, (len(points), 3, 3)))
        best = np.minimum(best, np.linalg.norm(there - points, axis=1))
    assert np.linalg.norm(found - points, axis=1) == pytest.approx(best, abs=1e-12)


def test_narrow_gaps_and_thin_walls_are_parted() -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([triangles, triangles + len(vertices)])
    beside = np.concatenate([vertices, vertices + np.array([2.02, 0, 0])])
    mesh = Sized(beside, both, np.full(len(beside), 0.15))
    part(mesh, np.ones(len(beside), bool))
    left = mesh.vertices[: len(vertices), 0].max()
    right = mesh.vertices[len(vertices) :, 0].min()
    assert right - left > 0.1
    flat = Sized(vertices * [1, 1, 0.05], triangles, np.full(len(vertices), 0.15))
    part(flat, np.ones(len(vertices), bool))
    assert np.ptp(flat.vertices[np.linalg.norm(vertices[:, :2], axis=1) < 0.3, 2]) > 0.15
    assert len(self_intersections(flat.vertices, flat.triangles)) == 0


def test_bodies_that_have_gone_through_each_other_draw_back() -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([triangles, triangles + len(vertices)])
    beside = np.concatenate([vertices, vertices + np.array([1.95, 0, 0])])
    mesh = Sized(beside, both, np.full(len(beside), 0.15))
    assert len(self_intersections(mesh.vertices, both)) > 0
    draw_back(mesh, np.ones(len(beside), bool))
    assert len(self_intersections(mesh.vertices, both)) == 0
    left = mesh.vertices[: len(vertices), 0].max()
    right = mesh.vertices[len(vertices) :, 0].min()
    assert right > left


def test_a_neck_that_is_too_thin_is_made_as_thick_as_its_edges_are_long() -> None:
    # A thread of three sides between two balls, as smoothing alone would leave it.
    thread = Manifold.cylinder(2.0, 0.01, 0.01, 3, True).refine_to_length(0.1)
    balls = [Manifold.sphere(0.5, 24).translate([0, 0, z]) for z in (-1.2, 1.2)]
    made = (balls[0] + thread + balls[1]).to_mesh64()
    vertices, triangles = np.asarray(made.vert_properties)[:, :3], np.asarray(made.tri_verts)
    mesh = Sized(vertices, triangles.astype(np.int64), np.full(len(vertices), 0.1))
    rounded(mesh, np.abs(mesh.vertices[:, 2]) < 0.7)
    middle = mesh.vertices[np.abs(mesh.vertices[:, 2]) < 0.3]
    assert np.linalg.norm(middle[:, :2], axis=1).min() > 0.02
    facts = topology(PolygonMesh.of_triangles(mesh.vertices, mesh.triangles))
    assert (facts.euler_number, facts.components) == (2, 1)
    assert len(self_intersections(mesh.vertices, mesh.triangles)) == 0


def test_no_large_triangle_stays_beside_the_small_ones_of_a_place_made_round() -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    mesh = Sized(vertices, triangles, np.where(vertices[:, 2] > 0.8, 0.05, 0.3))
    split_long(mesh)
    finer = rounded(mesh, mesh.vertices[:, 2] > 0.8)
    table = EdgeTable.of(mesh.triangles)
    lengths = table.lengths(mesh.vertices)
    longest, shortest = np.zeros(len(mesh.vertices)), np.full(len(mesh.vertices), np.inf)
    np.maximum.at(longest, table.ends, lengths[:, None])
    np.minimum.at(shortest, table.ends, lengths[:, None])
    # Edges are between 0.6 and 4 / 3 target lengths, which grow by less than half over an edge.
    assert (longest / shortest).max() < 1.5 * (4 / 3) / 0.6
    assert finer[mesh.vertices[:, 2] > 0.8].all()
    assert not finer[mesh.vertices[:, 2] < 0].any()


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
    surface = source.true_surface(frame, 2)
    cells = np.stack(np.meshgrid(*3 * [np.arange(30)], indexing="ij"), axis=-1) + 0.5
    radius = np.linalg.norm(cells * 0.1 - 1.5, axis=-1)
    interior = (radius > 0.9) & (radius < 1.04)
    generators, inside = mirrored(surface, interior, 2, np.random.default_rng(0))
    found = topology(interface(generators, inside).mesh)
    assert (found.euler_number, found.components) == (4, 2) == source.topology()


def test_moves_that_would_make_triangles_cross_are_taken_back() -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    aside, up = np.array([1.05, 0, 0]), np.array([0, 0, 0.1])
    both = np.concatenate([vertices - aside, vertices + aside])
    corners = np.concatenate([triangles, len(vertices) + triangles])
    left = np.arange(len(both)) < len(vertices)
    # The left ball grows towards the right one, and upwards.
    after = both + np.where((left & (both[:, 0] > -0.3))[:, None], [0.3, 0, 0], 0)
    after = after + np.where((left & (both[:, 2] > 0.9))[:, None], [0, 0, 0.2], 0)
    assert len(self_intersections(after, corners)) > 0
    kept = kept_embedded(both, after, corners)
    assert len(self_intersections(kept, corners)) == 0
    assert kept[left, 2].max() == pytest.approx(1.2)
    assert (kept[~left] == both[~left]).all()
    # What crossed before is no reason to put anything back.
    crossing = both - np.where(left[:, None], [-0.2, 0, 0], 0)
    again = kept_embedded(crossing, crossing + up, corners)
    assert again == pytest.approx(crossing + up)
