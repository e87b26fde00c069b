"""Openings with a flat edge are closed by caps, where that gives a solid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import random_rotation, sphere_mesh, write_ply

from vorolight.stages.inputs.mesh.caps import capped
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.mesh.geometry import enclosed_volume, fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology


def without_ends(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a solid along z, but for those at its ends."""
    kept = np.abs(mesh.face_normals[:, 2]) < 0.9
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)[kept]


@pytest.mark.parametrize(
    ("solid", "openings", "euler_number"),
    [
        (trimesh.creation.cylinder(1.0, 6.0, sections=40), 2, 2),
        (trimesh.creation.box((1.0, 2.0, 5.0)), 2, 2),
        # The inner edge and the outer one of an end lie in one plane, with a ring between them.
        (trimesh.creation.annulus(0.8, 1.0, 6.0, sections=32), 4, 0),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_ends_are_closed(
    solid: trimesh.Trimesh, openings: int, euler_number: int, seed: int, tmp_path: Path
) -> None:
    vertices, triangles = without_ends(solid)
    if seed:
        vertices = 300.0 * vertices @ random_rotation(seed).T + 1000.0
    source = MeshSource(write_ply(tmp_path / "open.ply", vertices, triangles))
    assert source.open_edges == 0
    assert source.sureness == 1
    assert source.describe()["capped_openings"] == openings
    assert f"{openings} openings with a flat edge" in source.warnings()[0]
    assert source.topology() == (euler_number, 1)
    volume = enclosed_volume(*fan_triangles(source.welded)[:2])
    assert volume == pytest.approx(solid.volume * (300.0**3 if seed else 1), rel=1e-5)


def test_bowls_sheets_and_what_bends_are_not_closed() -> None:
    vertices, triangles = sphere_mesh()
    centre = vertices[triangles].mean(axis=1)
    bowl = PolygonMesh.of_triangles(vertices, triangles[centre[:, 2] < 0])
    assert capped(bowl) is None
    side = np.linspace(-1, 1, 12)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    cell = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    hill = np.stack([x, y, 0.3 * (1 - x**2) * (1 - y**2)], axis=1)
    corners = np.concatenate([[cell, cell + 1, cell + 13], [cell, cell + 13, cell + 12]], axis=1)
    assert capped(PolygonMesh.of_triangles(hill, corners.T)) is None
    angle = np.arctan2(centre[:, 1], centre[:, 0])
    wavy = triangles[centre[:, 2] < 0.8 + 0.13 * np.cos(2 * angle)]
    assert capped(PolygonMesh.of_triangles(vertices, wavy)) is None


def test_what_crosses_a_cap_is_united_with_it() -> None:
    vertices, triangles = without_ends(trimesh.creation.box((2.0, 2.0, 6.0)))
    found = capped(PolygonMesh.of_triangles(vertices, triangles))
    assert found is not None
    assert topology(found[0]).closed
    needle = trimesh.creation.cylinder(0.2, 10.0, sections=8)
    both = np.concatenate([vertices, needle.vertices])
    crossed = np.concatenate([triangles, needle.faces + len(vertices)])
    solid = capped(PolygonMesh.of_triangles(both, crossed))
    assert solid is not None
    facts = topology(solid[0])
    assert (facts.closed, facts.euler_number, facts.components) == (True, 2, 1)
    volume = enclosed_volume(*fan_triangles(solid[0])[:2])
    # The needle is twice as long as what it leaves at both ends of the box.
    assert volume == pytest.approx(24 + 0.4 * needle.volume, rel=1e-6)


def test_other_bad_edges_are_left_alone() -> None:
    vertices, triangles = without_ends(trimesh.creation.cylinder(1.0, 6.0, sections=12))
    fin = np.concatenate([vertices, [[3.0, 0.0, 0.0]]])
    corners = np.concatenate([triangles, [[triangles[0, 0], triangles[0, 1], len(vertices)]]])
    assert capped(PolygonMesh.of_triangles(fin, corners)) is None
