"""Diagrams: interfaces, gradients, degenerate input, conformity."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import ball, exact_pairs, random_rotation, sphere_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.errors import NumericalFailure
from vorolight.stages.mesh import geometry
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology
from vorolight.stages.voronoi.conformity import Conformity, conformity
from vorolight.stages.voronoi.diagram import shull_child
from vorolight.stages.voronoi.diagram.cleanup import clean
from vorolight.stages.voronoi.diagram.delaunay import (
    BACKENDS,
    backend,
    by_shull,
    delaunay,
    in_passing,
)
from vorolight.stages.voronoi.diagram.interface import interface, without_islands
from vorolight.stages.voronoi.diagram.vertices import circumcentres, voronoi_vertices
from vorolight.stages.voronoi.pairs import label_pairs
from vorolight.stages.voronoi.trained_surface import TrainedSurface


def sphere_pairs(
    level: int = 2, radius: float = 0.25
) -> tuple[PolygonMesh, np.ndarray, np.ndarray]:
    return exact_pairs(*sphere_mesh(1.0, level), radius)


@given(st.integers(0, 10**6))
def test_interface_of_random_labels_is_closed(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, (400, 3))
    labels = np.random.default_rng(seed + 1).random(400) < 0.5
    labels &= np.abs(points).max(axis=1) < 0.6
    surface = interface(points, labels)
    assert topology(surface.mesh).closed
    area, normal, _ = geometry.face_frames(surface.mesh)
    ahead = points[surface.generators[:, 1]] - points[surface.generators[:, 0]]
    solid = area > 1e-12
    assert (np.einsum("ij,ij->i", normal, ahead)[solid] > 0).all()


def test_interface_vertices_are_equidistant_and_empty() -> None:
    points, labels = ball()
    surface = interface(points, labels)
    distance = np.linalg.norm(points[surface.tetrahedra] - surface.mesh.vertices[:, None], axis=2)
    assert np.allclose(distance, distance[:, :1], rtol=1e-6)
    from scipy.spatial import cKDTree

    nearest, _ = cKDTree(points).query(surface.mesh.vertices)
    assert np.allclose(nearest, distance[:, 0], rtol=1e-6)


def test_interface_is_that_of_scipys_voronoi() -> None:
    from scipy.spatial import Voronoi

    points, labels = ball(3)
    other = Voronoi(points)
    mixed = labels[other.ridge_points[:, 0]] != labels[other.ridge_points[:, 1]]
    theirs = {frozenset(pair) for pair in other.ridge_points[mixed].tolist()}
    ours = {frozenset(pair) for pair in interface(points, labels).generators.tolist()}
    assert ours == theirs


@given(st.integers(0, 10**6), st.integers(-20, 20))
def test_interface_turns_and_scales(seed: int, power: int) -> None:
    points, labels = ball(5, 600)
    before = interface(points, labels)
    turned = interface(points @ random_rotation(seed).T, labels)
    assert np.array_equal(np.sort(before.generators, 0), np.sort(turned.generators, 0))
    scaled = interface(points * 2.0**power, labels)
    assert np.array_equal(scaled.mesh.vertices, before.mesh.vertices * 2.0**power)
    assert np.array_equal(scaled.mesh.face_vertices, before.mesh.face_vertices)


def test_voronoi_vertices_gradient_against_finite_differences() -> None:
    random = np.random.default_rng(2)
    points = torch.tensor(random.random((6, 3)), requires_grad=True)
    tetrahedra = torch.tensor([[0, 1, 2, 3], [5, 2, 4, 1]])
    assert torch.autograd.gradcheck(lambda x: voronoi_vertices(x, tetrahedra), points)
    ours = voronoi_vertices(points, tetrahedra).detach().numpy()
    assert np.allclose(ours, circumcentres(points.detach().numpy(), tetrahedra.numpy())[0])


@given(st.integers(0, 10**6))
def test_every_backend_gives_the_same_bits(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.normal(size=(int(random.integers(6, 200)), 3))
    expected = delaunay(points)
    assert (np.diff(expected.corners, axis=1) > 0).all()
    for name in BACKENDS:
        with backend(name) as used:
            found = in_passing(points)
        assert np.array_equal(found.corners, expected.corners)
        assert np.array_equal(found.neighbours, expected.neighbours)
        assert (used.diagrams, used.warning()) == (1, None)


def test_a_backend_that_fails_is_stood_in_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise RuntimeError("internal corruption")

    monkeypatch.setitem(BACKENDS, "shull", fails)
    points = np.random.default_rng(0).normal(size=(50, 3))
    with backend("shull") as used:
        found = in_passing(points)
    assert np.array_equal(found.corners, delaunay(points).corners)
    assert used.warning() == (
        "--backend shull failed in 1 of 1 diagrams (internal corruption); "
        "scipy computed those instead"
    )


def test_shull_says_what_it_cannot_do_and_survives_its_death() -> None:
    with pytest.raises(RuntimeError, match="shull"):
        by_shull(np.zeros((8, 3)))
    points = np.random.default_rng(0).normal(size=(50, 3))
    before = by_shull(points)[0]
    shull_child._CHILD[0].kill()
    shull_child._CHILD[0].wait()
    with pytest.raises(RuntimeError, match="ended"):
        by_shull(points)
    assert np.array_equal(by_shull(points)[0], before)


def test_tetrahedra_that_overlap_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    corners, neighbours = by_shull(points)
    # One of them stretched over others.
    wrong = corners.copy()
    wrong[0, 0] = np.setdiff1d(np.arange(50), wrong[0])[0]
    monkeypatch.setattr(shull_child, "tetrahedra", lambda _: (wrong, neighbours))
    with pytest.raises(RuntimeError, match="overlap"):
        by_shull(points)


def test_what_no_backend_can_be_given_is_refused() -> None:
    points, _ = ball(0, 50)
    with pytest.raises(NumericalFailure, match="coincide"):
        delaunay(np.concatenate([points, points[:1]]))
    with pytest.raises(NumericalFailure, match="not finite"):
        delaunay(np.concatenate([points, [[np.nan, 0, 0]]]))
    with pytest.raises(NumericalFailure, match="too few"):
        delaunay(points[:4])
    with pytest.raises(NumericalFailure, match="Qhull"):
        delaunay(points * [1, 1, 0] + [0, 0, 1])


def test_an_interface_that_reaches_the_hull_is_refused() -> None:
    points, _ = ball(0, 100)
    with pytest.raises(NumericalFailure, match="unbounded"):
        interface(points, points[:, 0] > 0)


@pytest.mark.parametrize("radius", [0.22, 0.28])
def test_clean_interface_of_exact_pairs_is_the_trained_surface(radius: float) -> None:
    mesh, inside, outside = sphere_pairs(2, radius)
    count = mesh.face_count
    raw = interface(np.concatenate([inside, outside]), np.arange(2 * count) < count)
    result = clean(raw, spacing=0.3)
    assert topology(result.mesh).closed
    assert result.mesh.face_count == count
    assert np.array_equal(result.generators[:, 0], result.generators[:, 1] - count)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(mesh.vertices).query(result.mesh.vertices)
    assert distance.max() < 1e-12


@pytest.mark.parametrize("merge", [1e-8, 1e-6, 1e-3, 1e-1])
@pytest.mark.parametrize("flat", [1e-12, 1e-9, 1e-4])
def test_clean_up_never_opens_a_surface(merge: float, flat: float) -> None:
    points, labels = ball(7, 800)
    assert topology(clean(interface(points, labels), 0.2, flat, merge).mesh).closed
    mesh, inside, outside = sphere_pairs(1, 0.45)
    count = mesh.face_count
    raw = interface(np.concatenate([inside, outside]), np.arange(2 * count) < count)
    assert topology(clean(raw, 0.5, flat, merge).mesh).closed


def test_conformity_of_exact_pairs_and_of_a_moved_one() -> None:
    mesh, inside, outside = sphere_pairs(2, 0.25)
    count, ones = mesh.face_count, np.ones(mesh.face_count)

    def measure(inner: np.ndarray) -> Conformity:
        radii = np.full(mesh.vertex_count, 0.25)
        trained = TrainedSurface(mesh, radii, inner, outside, ones, ones)
        return conformity(trained.interface(), trained, spacing=0.3)

    exact = measure(inside)
    assert exact.pair_faces == count
    assert exact.pair_area_share == pytest.approx(1, abs=1e-9)
    moved = inside.copy()
    moved[0] *= 0.9
    worse = measure(moved)
    assert worse.pair_area_share < 1 - 1e-5
    assert worse.residual_max > 100 * exact.residual_max + 1e-6


def test_pairs_are_labelled_by_the_inside_not_by_the_normal() -> None:
    mesh, inside, outside = sphere_pairs(1, 0.45)
    ahead, behind = outside.copy(), inside.copy()
    ahead[3], behind[3] = inside[3], outside[3]
    pairs = label_pairs(mesh, ahead, behind)
    assert np.array_equal(pairs.inside, inside)
    assert np.array_equal(pairs.outside, outside)
    assert (pairs.relabelled, pairs.replaced, pairs.undecided) == (1, 0, 0)


def test_a_pair_on_one_side_is_set_across_its_face() -> None:
    mesh, inside, outside = sphere_pairs(1, 0.45)
    off = inside.copy()
    # Beyond all others: the interface of these labels would have a face without end.
    off[7] = 2.0 * outside[7]
    with pytest.raises(NumericalFailure, match="unbounded"):
        interface(np.concatenate([off, outside]), np.arange(2 * len(off)) < len(off))
    pairs = label_pairs(mesh, outside, off)
    assert (pairs.relabelled, pairs.replaced, pairs.undecided) == (0, 1, 0)
    assert np.linalg.norm(pairs.inside[7]) < 1 < np.linalg.norm(pairs.outside[7])
    interface(np.concatenate([pairs.inside, pairs.outside]), np.arange(2 * len(off)) < len(off))


def test_specks_are_removed() -> None:
    points, labels = ball(11, 3000)
    corner = np.argmin(np.linalg.norm(points - 0.8, axis=1))
    middle = np.argmin(np.linalg.norm(points, axis=1))
    noisy = labels.copy()
    noisy[corner], noisy[middle] = True, False
    assert topology(interface(points, noisy).mesh).components == 3
    left, kept, gone = without_islands(points, noisy, smallest=0.05)
    assert gone == 2
    assert topology(interface(left, kept).mesh).components == 1
