"""Polyhedral cells: closed, sound, slivers merged, moments, and quality as OpenFOAM has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import ball, fibonacci

from vorolight.stages.errors import NumericalFailure
from vorolight.stages.mesh import geometry
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.polyhedra import PolyhedralMesh
from vorolight.stages.mesh.topology import edges
from vorolight.stages.metrics.polyhedra import quality
from vorolight.stages.training.cvt import Descent
from vorolight.stages.voronoi.cells.assembly import contracted, raw_cells
from vorolight.stages.voronoi.cells.boundary import Boundary
from vorolight.stages.voronoi.cells.checks import cell_faults
from vorolight.stages.voronoi.cells.interior import Guard, sample
from vorolight.stages.voronoi.cells.moments import cell_moments
from vorolight.stages.voronoi.cells.slivers import merged
from vorolight.stages.voronoi.diagram.cleanup import clean
from vorolight.stages.voronoi.diagram.delaunay import delaunay
from vorolight.stages.voronoi.diagram.interface import interface


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
    tolerance = 0.03
    found = merged(cells, tolerance, at)
    assert found.contracted_vertices > 50
    assert found.spared_vertices == 0
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
    assert shortest(found.mesh) >= tolerance * smallest


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
    # Measured 0.022: generators that press against the spheres cannot reach their centroids.
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


def two_boxes(length: float, shear: float = 0.0) -> PolyhedralMesh:
    """A unit cube beside a box of ``length``, their common face moved by ``shear`` of its height
    at the top."""
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    layers = [np.column_stack([np.full(4, x), square]) for x in (0.0, 1.0, 1.0 + length)]
    vertices = np.concatenate(layers)
    vertices[4:8, 0] += shear * vertices[4:8, 2]
    ring = [4, 5, 6, 7]  # its normal is x, from the cube to the box
    faces = [ring, [3, 2, 1, 0], [8, 9, 10, 11]]
    for low, high in ((0, 4), (4, 8)):
        faces += [[low + k, low + (k + 1) % 4, high + (k + 1) % 4, high + k] for k in range(4)]
    mesh = PolygonMesh.of_triangles(vertices, np.array(faces))
    owner = np.array([0, 0, 1, 0, 0, 0, 0, 1, 1, 1, 1])
    neighbour = np.array([1, *([-1] * 10)])
    return PolyhedralMesh(mesh, owner, neighbour, np.arange(2), 12)


def test_quality_of_boxes() -> None:
    found = quality(two_boxes(3.0))
    assert found.volume.tolist() == pytest.approx([1, 3])
    assert found.non_orthogonality.tolist() == pytest.approx([0], abs=1e-5)
    assert found.skewness == pytest.approx(np.zeros(11), abs=1e-12)
    # Sums of |S_f| by axis are 2, 6, 6: three times as long, and 14 / (6 * 3^(2/3)) of a cube's.
    assert found.aspect.tolist() == pytest.approx([1, 3])
    assert found.size_ratio.tolist() == pytest.approx([3 ** (1 / 3)])
    assert found.cell_skewness == pytest.approx([0, 0], abs=1e-12)
    # The common face leans by 45 degrees; the line between the centroids stays nearly level.
    leaning = quality(two_boxes(3.0, 0.5))
    angle = np.degrees(np.arctan(0.5))
    assert leaning.non_orthogonality[0] == pytest.approx(angle, abs=2)
    assert leaning.cell_non_orthogonality.tolist() == pytest.approx(
        2 * [float(leaning.non_orthogonality[0])]
    )
