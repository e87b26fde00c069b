"""Polygon meshes: geometry with closed answers, topology of known shapes, edits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import random_rotation, sphere_mesh, torus_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.mesh import edits, frames, geometry, spheres
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import bad_edges, pinched_vertices, topology

CUBE = PolygonMesh(
    np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float),
    np.arange(7) * 4,
    np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]),
)


def test_cube() -> None:
    area, normal, centroid = geometry.face_frames(CUBE)
    assert np.allclose(area, 1)
    assert np.allclose(centroid, 0.5 + 0.5 * normal)
    assert geometry.enclosed_volume(*geometry.fan_triangles(CUBE)[:2]) == pytest.approx(1)
    facts = topology(CUBE)
    assert (facts.vertices, facts.edges, facts.faces, facts.euler_number) == (8, 12, 6, 2)
    assert facts.closed
    assert facts.pinched_vertices == 0
    assert facts.components == 1


@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_frames_turn_and_scale_with_the_mesh(seed: int, scale: float) -> None:
    turn = random_rotation(seed)
    moved = CUBE.with_vertices(scale * CUBE.vertices @ turn.T + 3)
    area, normal, centroid = geometry.face_frames(moved)
    area0, normal0, centroid0 = geometry.face_frames(CUBE)
    assert np.allclose(area, scale**2 * area0, rtol=1e-9)
    assert np.allclose(normal, normal0 @ turn.T, atol=1e-9)
    assert np.allclose(centroid, scale * centroid0 @ turn.T + 3, atol=1e-9 * (scale + 3))


def test_centroid_of_an_irregular_polygon_ignores_clustered_corners() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.9999, 1, 0], [0.9998, 1, 0], [0, 1, 0]])
    mesh = PolygonMesh(square.astype(float), np.array([0, 6]), np.arange(6))
    area, _, centroid = geometry.face_frames(mesh)
    assert np.allclose(area, 1)
    assert np.allclose(centroid, [[0.5, 0.5, 0]], atol=1e-12)


def test_torch_frames_agree_with_numpy() -> None:
    vertices = torch.tensor(CUBE.vertices + 0.1 * np.random.default_rng(0).random((8, 3)))
    found = frames.face_frames(vertices, frames.Connectivity.of(CUBE))
    area, normal, centroid = geometry.face_frames(CUBE.with_vertices(vertices.numpy()))
    for ours, theirs in ((found.area, area), (found.normal, normal), (found.centroid, centroid)):
        assert np.allclose(ours.numpy(), theirs, atol=1e-12)


def test_torch_frames_gradient_against_finite_differences() -> None:
    connectivity = frames.Connectivity.of(CUBE)
    start = torch.tensor(CUBE.vertices + 0.1 * np.random.default_rng(1).random((8, 3)))

    def outputs(vertices: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = frames.face_frames(vertices, connectivity)
        return found.area, found.normal, found.centroid, found.fan_centres

    assert torch.autograd.gradcheck(outputs, start.requires_grad_(True))


def test_open_flipped_and_pinched_meshes_are_told_apart() -> None:
    keep = np.ones(6, bool)
    keep[0] = False
    assert len(bad_edges(CUBE.select_faces(keep))) == 4
    corners = CUBE.face_vertices.copy()
    corners[:4] = corners[:4][::-1]
    flipped = PolygonMesh(CUBE.vertices, CUBE.face_offsets, corners)
    assert len(bad_edges(flipped)) == 4
    other = np.where(CUBE.face_vertices == 0, 0, CUBE.face_vertices + 8)
    twins = PolygonMesh(
        np.concatenate([CUBE.vertices, -CUBE.vertices]),
        np.arange(13) * 4,
        np.concatenate([CUBE.face_vertices, other[::-1]]),
    )
    assert pinched_vertices(twins).tolist() == [0]
    assert topology(twins).closed
    assert topology(twins).components == 2


@pytest.mark.parametrize(("mesh", "euler"), [(sphere_mesh(), 2), (torus_mesh(1, 0.4, 24, 12), 0)])
def test_euler_number(mesh: tuple[np.ndarray, np.ndarray], euler: int) -> None:
    facts = topology(PolygonMesh.of_triangles(*mesh))
    assert facts.euler_number == euler
    assert facts.closed


def test_samples_are_uniform_by_area() -> None:
    vertices, triangles, _ = geometry.fan_triangles(CUBE.with_vertices(CUBE.vertices * [1, 1, 3]))
    points, _ = geometry.sample_triangles(vertices, triangles, 40_000, np.random.default_rng(0))
    on_caps = ((points[:, 2] < 1e-9) | (points[:, 2] > 3 - 1e-9)).mean()
    # Two caps of area 1 out of 14; four standard deviations of a share of 40,000 samples.
    assert on_caps == pytest.approx(2 / 14, abs=4 * np.sqrt(2 / 14 * 12 / 14 / 40_000))


def test_short_edges_contract_and_faces_follow() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.999, 1, 0], [0, 1, 0]], float)
    mesh = PolygonMesh(vertices, np.array([0, 5]), np.arange(5))
    target = edits.contract_short_edges(mesh, 0.01)
    reduced, kept = edits.reduce_rings(mesh, target)
    assert kept.all()
    assert reduced.face_vertices.tolist() == [0, 1, 2, 4]
    gone, kept = edits.reduce_rings(mesh, np.array([0, 1, 1, 1, 0]))
    assert not kept.any()
    assert gone.face_count == 0


def test_initial_spheres_of_the_cube() -> None:
    radii, offsets = spheres.initial_spheres(CUBE)
    assert np.allclose(radii, np.sqrt(0.5))
    assert np.allclose(offsets, 1)


def test_near_pairs_are_all_but_the_incident_ones() -> None:
    _, _, centroid = geometry.face_frames(CUBE)
    targets = np.concatenate([centroid, centroid])
    point, sphere = spheres.near_pairs(CUBE, targets, CUBE.vertices, np.full(8, 10.0), 0.0, 1)
    assert len(point) == 12 * (8 - 4)
    for p, v in zip(point, sphere, strict=True):
        face = p % 6
        assert v not in CUBE.face_vertices[4 * face : 4 * face + 4]
