"""Metrics on surfaces whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import sphere_mesh, torus_mesh

from vorolight.stages.metrics import chamfer, curvature
from vorolight.stages.surface import geometry
from vorolight.stages.surface.polygons import PolygonMesh


def test_curvature_of_a_sphere() -> None:
    vertices, triangles = sphere_mesh(2.0, 4)
    found, valid = curvature.mean_curvature(vertices, triangles, 0.3)
    assert valid.all()
    # A quadric through a cap of angle 0.15 misses the fourth order: under 1 %.
    assert np.abs(found) * 2 == pytest.approx(1, abs=0.01)
    facts = curvature.statistics(vertices, triangles, 0.3, found, valid)
    assert facts is not None
    assert facts.mean * 2 == pytest.approx(1, abs=0.01)
    assert facts.valid_share == 1


def test_curvature_of_a_torus() -> None:
    vertices, triangles = torus_mesh(2.0, 0.8, 192, 96)
    found, valid = curvature.mean_curvature(vertices, triangles, 0.15)
    ring = np.hypot(vertices[:, 0], vertices[:, 1])
    cosine = (ring - 2.0) / 0.8
    exact = (2.0 + 2 * 0.8 * cosine) / (2 * 0.8 * (2.0 + 0.8 * cosine))
    assert valid.all()
    assert np.abs(np.abs(found) - np.abs(exact)).max() < 0.02 * np.abs(exact).max()


def test_too_few_neighbours_are_not_valid() -> None:
    vertices, triangles = sphere_mesh(1.0, 1)
    _, valid = curvature.mean_curvature(vertices, triangles, 0.1)
    assert not valid.any()
    assert curvature.statistics(vertices, triangles, 0.1, np.zeros(len(vertices)), valid) is None


def test_dihedral_mean_curvature() -> None:
    smooth = curvature.dihedral_mean_curvature(PolygonMesh.of_triangles(*sphere_mesh(1.0, 4)))
    assert smooth == pytest.approx(1, abs=0.01)
    cube = PolygonMesh(
        np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float),
        np.arange(7) * 4,
        np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]),
    )
    assert curvature.dihedral_mean_curvature(cube) == pytest.approx(12 * np.pi / 2 / (2 * 6))


def test_chamfer_of_one_surface_is_its_sampling_floor() -> None:
    vertices, triangles = sphere_mesh(0.2, 4)
    one, two = (
        geometry.sample_triangles(vertices, triangles, 20_000, np.random.default_rng(seed))[0]
        for seed in (0, 1)
    )
    area = float(geometry.triangle_areas(vertices, triangles).sum())
    found = chamfer.chamfer(one, two, 0.01, area)
    assert found.cd2 == pytest.approx(found.sampling_floor, rel=0.05)
    assert found.f1 == pytest.approx(1, abs=1e-3)
    apart = chamfer.chamfer(one, two + np.array([0.5, 0, 0]), 0.01, area)
    assert apart.f1 < 0.1
    assert apart.cd2 > 0.02
