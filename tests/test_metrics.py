"""Metrics on surfaces whose answers are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, fibonacci, sphere_mesh, surface_of, torus_mesh, write_ply

from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.inputs.points.source import PointSource
from vorolight.stages.mesh import geometry
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.metrics import chamfer, curvature
from vorolight.stages.metrics.departures import departures
from vorolight.stages.metrics.fidelity import fidelity
from vorolight.stages.metrics.protocols import PROTOCOLS


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


def test_distances_between_concentric_spheres(tmp_path: Path) -> None:
    truth = surface_of(tmp_path / "one.ply", sphere_mesh(1.0, 5))
    vertices, triangles = sphere_mesh(1.02, 5)
    random = np.random.default_rng(0)
    points = geometry.sample_triangles(*sphere_mesh(1.0, 5), 20_000, random)[0]
    normals = truth.closest(points)[1]
    found = fidelity(vertices, triangles, truth, (points, normals), 20_000, random, 2)
    # Facets of level 5 lie up to 0.0004 inside their sphere, both spheres' alike.
    assert found.to_reference_cd2 == pytest.approx(0.02**2, rel=0.02)
    assert found.from_reference_cd2 == pytest.approx(0.02**2, rel=0.02)
    assert found.rms == pytest.approx(0.02, rel=0.02)
    assert found.p99 == pytest.approx(0.02, rel=0.05)
    assert found.normal_consistency == pytest.approx(1, abs=1e-3)
    other = geometry.sample_triangles(vertices, triangles, 20_000, random)[0]
    near, far = (chamfer.chamfer(other, points, limit, 4 * np.pi) for limit in (0.01, 0.08))
    assert (near.f1, far.f1) == (0, pytest.approx(1, abs=1e-3))


def test_resampled_curvature_does_not_depend_on_the_mesh() -> None:
    """A mesh with fewer than 8 vertices within the radius has no valid fit; divided it has."""
    vertices, triangles = sphere_mesh(1.0, 3)
    assert not curvature.mean_curvature(vertices, triangles, 0.1)[1].any()
    for level in (3, 4):
        found, _ = curvature.resampled(*sphere_mesh(1.0, level), 0.05)
        assert found is not None
        assert found.valid_share == 1
    # With a radius of four edges the facets average out, but for two hundredths.
    smooth, _ = curvature.resampled(*sphere_mesh(1.0, 4), 0.15)
    assert smooth is not None
    assert smooth.mean == pytest.approx(1, abs=0.03)
    assert curvature.resampled(vertices, triangles, 1e-4) == (None, None)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_protocols_are_named_with_what_was_changed(name: str, heart_run: Path, cli: Cli) -> None:
    words = ("--of", "init", "--protocol", name, "--samples", 3000)
    done = cli("evaluate", *words, cwd=heart_run.parent)
    assert done.returncode == 0, done.stderr
    threshold = {"vorolight": 0.01, "voromesh": 0.003}[name]
    assert f"protocol {name} (changed: samples): 3000 samples, F1 at {threshold}" in done.stdout
    found = json.loads((heart_run / "evaluate-init.json").read_text())["metrics"]
    assert found["protocol"]["threshold"] == threshold
    assert found["gates"]["closed"] is True
    assert found["gates"]["topology"] == "not known: the topology of the reference is not known"
    for path in heart_run.glob("evaluate-init.*"):
        path.unlink()


def test_what_only_the_surface_or_only_the_input_has_is_named(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(5.0)
    both = np.concatenate([vertices, 0.4 * vertices + [20.0, 0, 0]])
    twice = np.concatenate([triangles, triangles + len(vertices)])
    frame = ModelFrame(np.zeros(3), 0.5)
    for own, other in ((False, True), (True, False), (True, True)):
        source = MeshSource(
            write_ply(tmp_path / "input.ply", *((both, twice) if other else (vertices, triangles)))
        )
        surface = source.true_surface(frame, 1)
        written = PolygonMesh.of_triangles(*((both, twice) if own else (vertices, triangles)))
        written = written.with_vertices(frame.model_from_input(written.vertices))
        found = departures(written, source, surface, frame, 1)
        for part, alone in ((found.surface, own and not other), (found.input, other and not own)):
            # The smaller ball has 0.16 of the larger one's area, more of the input's samples since
            # its triangles are smaller; its far side is 17 away.
            assert part.far == pytest.approx(0.16 / 1.16 if alone else 0, abs=0.03)
            assert part.largest == pytest.approx(34 if alone else 0, abs=0.5)
            if alone:
                assert part.place == pytest.approx([22, 0, 0], abs=1)
        said = found.warnings(0.5)
        assert len(said) == (own != other)
        if own and not other:
            assert "13 % of the surface lies further than 0.5, up to 17 at (2" in said[0]
        if other and not own:
            assert "16 % of the input lies further than 0.5, up to 17 at (2" in said[0]


def test_a_surface_where_no_points_are_is_named(tmp_path: Path) -> None:
    points = fibonacci(4000, 5.0)
    np.save(tmp_path / "cup.npy", points[points[:, 2] < 3.0])
    source = PointSource(tmp_path / "cup.npy")
    frame = ModelFrame(np.zeros(3), 0.5)
    vertices, triangles = sphere_mesh(5.0)
    written = PolygonMesh.of_triangles(frame.model_from_input(vertices), triangles)
    found = departures(written, source, source.true_surface(frame, 1), frame, 1)
    # The cap above z = 3 has 0.2 of the area, and its middle is sqrt(20) from the rim.
    assert 0.05 < found.surface.far < 0.2
    assert found.surface.largest == pytest.approx(20**0.5 / 0.5, rel=0.05)
    assert found.input.far == found.enclosed == 0
    # Points within it are of no surface.
    within = np.concatenate([points, 0.5 * points[:400]])
    source.__dict__["cloud"] = replace(source.cloud, points=within)
    source.__dict__["reconstruction"] = replace(
        source.reconstruction, kept=np.ones(len(within), dtype=bool)
    )
    filled = departures(written, source, source.true_surface(frame, 1), frame, 1)
    assert filled.enclosed == filled.input.far == pytest.approx(400 / len(within))
    assert "check whether they belong to the surface" in "".join(filled.warnings(0.5))
    assert "nothing was measured there" in found.warnings(0.5)[0]
