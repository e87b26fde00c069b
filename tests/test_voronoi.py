"""Diagrams: interfaces, cells, gradients, degenerate input, conformity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import fibonacci, random_rotation, sphere_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.errors import NumericalFailure
from vorolight.stages.optimize.cvt import Descent
from vorolight.stages.surface import geometry
from vorolight.stages.surface.polygons import PolygonMesh
from vorolight.stages.surface.topology import edges, topology
from vorolight.stages.voronoi import shull_child
from vorolight.stages.voronoi.boundary import Boundary
from vorolight.stages.voronoi.cell_checks import cell_faults
from vorolight.stages.voronoi.cells import PolyhedralMesh, contracted, raw_cells
from vorolight.stages.voronoi.cleanup import clean
from vorolight.stages.voronoi.conformity import conformity
from vorolight.stages.voronoi.delaunay import (
    BACKENDS,
    backend,
    by_shull,
    delaunay,
    in_passing,
)
from vorolight.stages.voronoi.interface import interface, without_islands
from vorolight.stages.voronoi.interior import Guard, sample
from vorolight.stages.voronoi.moments import cell_moments
from vorolight.stages.voronoi.pairs import label_pairs
from vorolight.stages.voronoi.slivers import merged
from vorolight.stages.voronoi.vertices import circumcentres, voronoi_vertices


def ball(seed: int = 0, count: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return points, np.linalg.norm(points, axis=1) < 0.6


def sphere_pairs(
    level: int = 2, radius: float = 0.25
) -> tuple[PolygonMesh, np.ndarray, np.ndarray]:
    """Triangles of a sphere with exact pairs: where equal spheres at their corners meet."""
    mesh = PolygonMesh.of_triangles(*sphere_mesh(1.0, level))
    a, b, c = (mesh.vertices[mesh.face_vertices.reshape(-1, 3)[:, k]] for k in range(3))
    _, normal, _ = geometry.face_frames(mesh)
    ab, ac = b - a, c - a
    cross = np.cross(ab, ac)
    arm = np.cross(cross, ab) * (ac**2).sum(1, keepdims=True)
    arm = arm + np.cross(ac, cross) * (ab**2).sum(1, keepdims=True)
    arm = arm / (2 * (cross**2).sum(1, keepdims=True))
    offset = np.sqrt(radius**2 - (arm**2).sum(1, keepdims=True))
    return mesh, a + arm - offset * normal, a + arm + offset * normal


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
        "--backend shull failed in 1 of 1 diagrams (internal corruption); scipy did those"
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
    count = mesh.face_count

    radii = np.full(mesh.vertex_count, 0.25)
    owner = np.arange(2 * count) % count

    def measure(inner: np.ndarray) -> object:
        raw = interface(np.concatenate([inner, outside]), np.arange(2 * count) < count)
        return conformity(raw, owner, mesh, radii, inner, outside, 0.3)

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


def cells_of(points: np.ndarray, labels: np.ndarray) -> tuple[PolyhedralMesh, PolygonMesh]:
    """The cells of the inside points, and the interface that they end at."""
    surface = interface(points, labels)
    cleaned = clean(surface, spacing=1.0)
    boundary = Boundary.cleaned(surface, labels, cleaned, cleaned.mesh, 1e-6)
    assert boundary is not None
    return raw_cells(points, labels, delaunay(points), boundary), cleaned.mesh


def test_cells_fill_the_surface_they_are_in() -> None:
    points, labels = ball(13)
    cells, surface = cells_of(points, labels)
    at = points[cells.cell_generator]
    assert {name: int(bad.sum()) for name, bad in cell_faults(cells, at).items()} == {
        "open": 0, "not_spheres": 0, "torn_faces": 0, "crossed_faces": 0, "few_faces": 0,
        "folded": 0,
    }  # fmt: skip
    assert cells.cell_count == labels.sum()
    enclosed = geometry.enclosed_volume(*geometry.fan_triangles(surface)[:2])
    assert cells.solids(at)[0].sum() == pytest.approx(enclosed, rel=1e-12)
    inner = int((cells.neighbour >= 0).sum())
    assert (cells.neighbour[inner:] == -1).all()
    assert (cells.owner[:inner] < cells.neighbour[:inner]).all()
    rank = cells.owner[:inner] * cells.cell_count + cells.neighbour[:inner]
    assert (np.diff(rank) > 0).all()  # as OpenFOAM wants them, and no two faces of one pair
    assert np.array_equal(cells.faces.vertices[: surface.vertex_count], surface.vertices)
    assert np.array_equal(cells.boundary.face_vertices, surface.face_vertices)
    assert np.array_equal(cells.boundary.face_offsets, surface.face_offsets)


def test_slivers_are_merged_and_nothing_else_is_changed() -> None:
    points, labels = ball(13)
    cells, surface = cells_of(points, labels)
    at = points[cells.cell_generator]
    found = merged(cells, 0.1, at)
    assert found.contracted_vertices > 50
    assert not any(found.faults.values())
    assert np.array_equal(found.mesh.boundary.face_vertices, surface.face_vertices)
    assert np.array_equal(found.mesh.faces.vertices[: surface.vertex_count], surface.vertices)
    total = cells.solids(at)[0].sum()
    assert found.mesh.solids(at)[0].sum() == pytest.approx(total, rel=1e-12)

    def shortest(mesh: PolyhedralMesh) -> float:
        """Of the edges inside."""
        ends = edges(mesh.faces)
        ends = ends[ends.max(axis=1) >= surface.vertex_count]
        return float(np.linalg.norm(np.diff(mesh.faces.vertices[ends], axis=1), axis=2).min())

    smallest = np.cbrt(cells.solids(at)[0].min())
    assert shortest(cells) < 0.01 * smallest
    if found.spared_vertices == 0:
        assert shortest(found.mesh) >= 0.1 * smallest


def test_faults_of_broken_cells_are_named() -> None:
    points, labels = ball(13)
    cells, _ = cells_of(points, labels)
    at = points[cells.cell_generator]
    face = int(np.flatnonzero(cells.neighbour >= 0)[0])
    keep = np.arange(cells.faces.face_count) != face
    gone = replace(
        cells, faces=cells.faces.select_faces(keep), owner=cells.owner[keep],
        neighbour=cells.neighbour[keep],
    )  # fmt: skip
    both = {int(cells.owner[face]), int(cells.neighbour[face])}
    assert set(np.flatnonzero(cell_faults(gone, at)["open"])) == both
    inner = np.flatnonzero(np.arange(cells.faces.vertex_count) >= cells.surface_vertices)
    moved = cells.faces.vertices.copy()
    moved[inner[0]] += 2.0
    assert cell_faults(cells.with_vertices(moved), at)["folded"].any()
    # Two opposite corners of one face become one vertex.
    ring = next(
        ring for ring in np.split(cells.faces.face_vertices, cells.faces.face_offsets[1:-1])
        if len(ring) == 6 and ring.min() >= cells.surface_vertices
    )  # fmt: skip
    target = np.arange(cells.faces.vertex_count)
    target[max(ring[0], ring[3])] = min(ring[0], ring[3])
    assert cell_faults(contracted(cells, target, cells.faces.vertices), at)["torn_faces"].any()


def test_cell_centroid_of_a_symmetric_cell() -> None:
    grid = np.stack(np.meshgrid(*[[-1.0, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    order = np.argsort(np.linalg.norm(grid, axis=1), kind="stable")
    found = cell_moments(grid[order], 1)
    assert found.volume[0] == pytest.approx(1, abs=1e-12)
    assert found.energy[0] == pytest.approx(0.25, abs=1e-12)  # 3 times 1/12 for a unit cube
    assert np.allclose(found.centroid, 0, atol=1e-12)


def test_moments_add_up_to_the_box_and_agree_with_the_polyhedra() -> None:
    points, labels = ball(19)
    order = np.argsort(~labels, kind="stable")
    points, labels = points[order], labels[order]
    cells, _ = cells_of(points, labels)
    volume, centroid = cells.solids(points[cells.cell_generator])
    found = cell_moments(points, int(labels.sum()), threads=2)
    assert found.volume == pytest.approx(volume, rel=1e-9)
    assert np.allclose(found.centroid, centroid, atol=1e-9)
    everything = cell_moments(points, len(points))
    edge = np.ptp(points, axis=0)
    box = np.prod(edge + 2 * edge.max())  # cells end at a box that far around
    assert everything.volume.sum() == pytest.approx(box, rel=1e-9)


def test_one_cell_among_thousands_of_neighbours() -> None:
    shell = 2 * fibonacci(3000)
    found = cell_moments(np.concatenate([[[0.01, 0.02, -0.01]], shell]), 1)
    assert found.volume[0] == pytest.approx(4 / 3 * np.pi, rel=0.01)  # a polyhedron around it


def test_inner_generators_leave_the_surface_alone() -> None:
    points, labels = ball(17, 4000)
    before = interface(points, labels)
    shell = np.unique(before.generators)  # only these touch the surface: room inside
    points, labels = points[shell], labels[shell]
    before = interface(points, labels)
    guard = Guard.of(points, labels, before)
    inner = sample(guard, 40, lambda _, i: np.random.default_rng(i), 1, lambda _: None)
    descent = Descent(guard, None, 1, inner)
    while not descent.done:
        descent.step()
    # Measured .022: generators that press against the spheres cannot reach their centroids.
    assert descent.residual < 0.05 * descent.residuals[0]
    inner = descent.points

    def cells(added: np.ndarray) -> PolyhedralMesh:
        cleaned = clean(before, spacing=1.0)
        boundary = Boundary.cleaned(before, labels, cleaned, cleaned.mesh, 1e-6)
        assert boundary is not None
        everything = np.concatenate([added, points])
        inside = np.concatenate([np.ones(len(added), bool), labels])
        return raw_cells(everything, inside, delaunay(everything), boundary, len(added))

    assert cells(inner).cell_count == 40 + labels.sum()
    with pytest.raises(NumericalFailure, match="changed it"):
        cells(before.mesh.vertices[:1] * 0.999)
