"""Tubes, plates, lamp: on shapes whose answers are known, and on the written file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import sphere_mesh

from vorolight.stages.fabrication import assembly, lamp, plates, printcheck, tubes
from vorolight.stages.surface.polygons import PolygonMesh

BALL = PolygonMesh.of_triangles(*sphere_mesh(30.0, 1))


def test_tubes_of_a_graph_have_its_genus() -> None:
    graph = tubes.tube_graph(BALL, 0.1)
    assert len(graph.nodes) == 42
    assert len(graph.tubes) == 120
    part = assembly.assemble(tubes.tubes(graph, 1.0, 8), None, False)
    assert part.genus == 120 - 42 + 1
    assert part.dropped_parts == 0


@pytest.mark.parametrize("sides", [4, 6, 8, 12, 16])
def test_tubes_are_nowhere_thinner_than_asked(sides: int) -> None:
    corners = tubes.ball(sides)
    enlarged = corners * tubes.compensation(corners)
    random = np.random.default_rng(0).normal(size=(200, 3))
    for direction in random / np.linalg.norm(random, axis=1, keepdims=True):
        helper = np.cross(direction, [0.3, 0.5, 0.8])
        first = helper / np.linalg.norm(helper)
        flat = enlarged @ np.stack([first, np.cross(direction, first)], axis=1)
        angles = np.linspace(0, 2 * np.pi, 90)
        across = np.stack([np.cos(angles), np.sin(angles)])
        assert (flat @ across).max(axis=0).min() >= 1 - 1e-6


def test_short_edges_are_welded() -> None:
    vertices = BALL.vertices.copy()
    a, b = BALL.face_vertices[:2]
    vertices[b] = vertices[a] + 0.01
    graph = tubes.tube_graph(BALL.with_vertices(vertices), 0.5)
    assert len(graph.nodes) == 41
    assert len(graph.tubes) == 120 - 3  # the edge, and one of two pairs on either side
    assert graph.faces.face_count == 78
    assert len(graph.face_sources) == 78


def test_plates() -> None:
    chosen = plates.choose(80, 0.25, np.random.default_rng(0))
    assert len(np.unique(chosen)) == 20
    bodies = plates.plates(BALL, chosen, 1.0)
    from vorolight.stages.surface.geometry import face_frames

    area = face_frames(BALL)[0][chosen]
    volumes = np.array([body.volume() for body in bodies])
    assert volumes == pytest.approx(area * 1.0, rel=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_mm_from_input_is_a_rotation_with_the_asked_height(up: str) -> None:
    vertices = np.random.default_rng(0).random((50, 3)) * [1, 2, 3] + 5
    matrix = lamp.mm_from_input(vertices, up, 100.0, 0.04, 0.6)
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    assert scale > 0
    assert np.allclose(linear @ linear.T, scale**2 * np.eye(3))
    z = (vertices @ linear.T + matrix[:3, 3])[:, 2]
    assert z.max() == pytest.approx(99.4)
    assert z.min() == pytest.approx(-0.04 * np.ptp(z))
    whole = lamp.mm_from_input(vertices, up, 100.0, 0.0, 0.6)
    z = (vertices @ whole[:3, :3].T + whole[:3, 3])[:, 2]
    assert (z.min(), z.max()) == pytest.approx((0.6, 99.4))


def test_the_cavity_is_where_there_is_room() -> None:
    ball = PolygonMesh.of_triangles(*sphere_mesh(60.0, 3))
    raised = ball.with_vertices(ball.vertices + np.array([7, 0, 50]))
    light = lamp.Light(38, 20, 0.5, 1.6)
    place = lamp.find_room(raised, light)
    # The ball cut 10 mm above its lowest point; the narrowest slice is the lowest one.
    assert place.x == pytest.approx(7, abs=2)
    assert place.y == pytest.approx(0, abs=2)
    assert 28 < place.room < np.sqrt(60**2 - 50**2)
    small = ball.with_vertices(0.2 * ball.vertices + np.array([0, 0, 11]))
    assert lamp.find_room(small, light).room < light.cavity_radius


def test_written_lamp(heart_run: Path, manifest: Callable[[str], dict[str, Any]]) -> None:
    found = printcheck.check(heart_run / "fabricate.stl")
    assert found.fault is None
    assert found.bodies == 1
    assert found.lowest_mm == pytest.approx(0, abs=1e-4)
    assert found.size_mm[2] == pytest.approx(120, abs=0.5)
    record = manifest("fabricate")
    assert record["frame"]["unit"] == "mm"
    assert record["metrics"]["as_written"]["triangles"] == found.triangles
    import trimesh

    mesh = trimesh.load_mesh(heart_run / "fabricate.stl")
    light = record["metrics"]["light"]
    # Looking up from the table there is a round hole for the light.
    section = mesh.section(plane_origin=[0, 0, 1.0], plane_normal=[0, 0, 1])
    radii = np.hypot(section.vertices[:, 0] - light["x_mm"], section.vertices[:, 1] - light["y_mm"])
    assert radii.min() == pytest.approx(light["cavity_diameter_mm"] / 2, rel=0.002)


def test_open_files_are_found_out(tmp_path: Path) -> None:
    from vorolight.stages.export import stl

    vertices, triangles = sphere_mesh()
    small = vertices.astype(np.float32)
    for faces, fault in (
        (triangles[1:], "watertight"),
        (triangles[:, ::-1], "inward"),
        (np.concatenate([triangles, triangles + len(small)]), "2 separate"),
    ):
        path = tmp_path / "a.stl"
        path.write_bytes(stl.encode(np.concatenate([small, small + 9]), faces))
        assert fault in (printcheck.check(path).fault or "")
