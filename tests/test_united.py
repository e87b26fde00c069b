"""Parts of a mesh that nearly meet, touch or cross each other: welded, told apart, united."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import sphere_mesh, write_ply

from vorolight.stages.formats import ply
from vorolight.stages.inputs.mesh import crossing_child
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.mesh.geometry import enclosed_volume
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology


def test_vertices_equal_in_single_precision_are_welded(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    random = np.random.default_rng(0)
    soup = vertices[triangles.reshape(-1)] + [10.0, 0, 0]
    soup = soup + 1e-7 * random.normal(size=soup.shape)
    faces = np.arange(len(soup)).reshape(-1, 3)
    source = MeshSource(write_ply(tmp_path / "soup.ply", soup, faces))
    assert source.topology() == (2, 1)
    assert source.describe()["welded_vertices"] == len(soup) - len(vertices)
    # What is further apart stays so: a slit of a thousandth is none of rounding.
    slit = soup + np.where((faces % 3 == 0).reshape(-1, 1), [0, 0, 1e-3], 0)
    assert MeshSource(write_ply(tmp_path / "slit.ply", slit, faces)).topology() is None


def test_features_smaller_than_rounding_are_kept_where_a_mesh_is_closed(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    tiny = np.concatenate([vertices, 1e-7 * vertices + [3.0, 0, 0]])
    both = np.concatenate([triangles, len(vertices) + triangles])
    path = tmp_path / "two.ply"
    path.write_bytes(ply.encode(PolygonMesh.of_triangles(tiny, both)))  # in double precision
    assert MeshSource(path).topology() == (4, 2)


def cubes(*shifts: tuple[float, float, float], turned: int = -1) -> tuple[np.ndarray, np.ndarray]:
    """Unit cubes, that of number ``turned`` inside out."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    parts = [triangles[:, ::-1] if n == turned else triangles for n in range(len(shifts))]
    return (
        np.concatenate([corners + shift for shift in shifts]),
        np.concatenate([8 * n + part for n, part in enumerate(parts)]),
    )


@pytest.mark.parametrize("turned", [-1, 1])
def test_closed_parts_that_cross_are_united(turned: int, tmp_path: Path) -> None:
    shift = (0.4, 0.3, 0.2)
    source = MeshSource(write_ply(tmp_path / "two.ply", *cubes((0, 0, 0), shift, turned=turned)))
    assert source.topology() == (2, 1)
    volume = enclosed_volume(source.vertices, source.triangles)
    assert volume == pytest.approx(2 - 0.6 * 0.7 * 0.8, rel=1e-6)
    assert source.describe()["united_parts"] == 2
    assert "2 closed parts of the mesh cross each other" in "".join(source.warnings())
    points = np.random.default_rng(0).uniform(-0.2, 1.6, (2000, 3))
    one, other = (((points > low) & (points < np.add(low, 1))).all(axis=1)
                  for low in ((0, 0, 0), shift))  # fmt: skip
    assert np.array_equal(source.inside(points), one | other)


def test_a_cavity_stays_one_where_another_part_crosses_its_body(tmp_path: Path) -> None:
    vertices, triangles = cubes((0, 0, 0), (0, 0, 0), (0.9, 0, 0), turned=1)
    vertices[8:16] = 0.5 * vertices[8:16] + 0.25
    source = MeshSource(write_ply(tmp_path / "hollow.ply", vertices, triangles))
    assert source.topology() == (4, 2)
    volume = enclosed_volume(source.vertices, source.triangles)
    assert volume == pytest.approx(2 - 0.1 - 0.125, rel=1e-6)


def test_parts_beside_or_within_each_other_are_left_as_they_are(tmp_path: Path) -> None:
    apart = MeshSource(write_ply(tmp_path / "apart.ply", *cubes((0, 0, 0), (1.5, 0.5, 0))))
    assert apart.topology() == (4, 2)
    assert apart.describe()["united_parts"] == 0
    assert apart.warnings() == []


def test_parts_within_others_are_solid_or_hollow_as_is_asked_for(tmp_path: Path) -> None:
    vertices, triangles = cubes(*[(0, 0, 0)] * 3, (5, 0, 0))
    for n, size in enumerate((1.0, 0.6, 0.2)):
        vertices[8 * n : 8 * n + 8] = size * (vertices[8 * n : 8 * n + 8] - 0.5) + 0.5
    path = write_ply(tmp_path / "nested.ply", vertices, triangles)
    source = MeshSource(path)
    assert source.topology() == (4, 2)
    assert enclosed_volume(source.vertices, source.triangles) == pytest.approx(2, rel=1e-6)
    assert source.describe()["buried_parts"] == 2
    assert "--shells alternate" in source.warnings()[0]
    source = MeshSource(path)
    source.hollow = True
    assert source.topology() == (8, 4)
    volume = enclosed_volume(source.vertices, source.triangles)
    assert volume == pytest.approx(2 - 0.6**3 + 0.2**3, rel=1e-6)
    assert "every second one becomes a hollow" in source.warnings()[0]
    # Of a cavity that faces inward nothing has to be said.
    vertices, triangles = cubes((0, 0, 0), (0, 0, 0), turned=1)
    vertices[8:] = 0.6 * (vertices[8:] - 0.5) + 0.5
    source = MeshSource(write_ply(tmp_path / "hollow.ply", vertices, triangles))
    assert source.warnings() == []
    assert source.topology() == (4, 2)
    # And a body in it stands by itself.
    body = 0.2 * (cubes((0, 0, 0))[0] - 0.5) + 0.5
    vertices = np.concatenate([vertices, body])
    triangles = np.concatenate([triangles, cubes((0, 0, 0))[1] + 16])
    source = MeshSource(write_ply(tmp_path / "more.ply", vertices, triangles))
    assert source.warnings() == []
    assert source.topology() == (6, 3)


@pytest.mark.parametrize(
    ("shift", "expected", "left_out"),
    [((1, 0, 0), (2, 1), 4), ((1, 1, 0), (4, 2), 0), ((0, 0, 0), (2, 1), 12)],
)
def test_parts_that_touch_are_closed(
    shift: tuple[float, float, float], expected: tuple[int, int], left_out: int, tmp_path: Path
) -> None:
    """Two cubes with a common face are one, along a common edge they stay two, and a surface that
    is there twice counts once."""
    vertices, triangles = cubes((0, 0, 0), shift)
    if left_out == 4:  # the common face is cut along the same diagonal
        mirrored = vertices[8:] * [-1, 1, 1] + [3, 0, 0]
        vertices = np.concatenate([vertices[:8], mirrored])
        triangles = np.concatenate([triangles[:12], triangles[12:, ::-1]])
    source = MeshSource(write_ply(tmp_path / "touch.ply", vertices, triangles))
    assert source.topology() == expected
    assert source.open_edges == 0
    assert f"{left_out} of its 24 faces, which are doubled" in source.warnings()[0]


def test_walls_between_stacked_boxes_are_left_out(tmp_path: Path) -> None:
    levels = 0.3 * np.arange(6)
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    vertices = np.concatenate([np.column_stack([square, np.full(4, z)]) for z in levels])
    faces = []
    for k in range(5):
        for a in range(4):
            b = (a + 1) % 4
            low, high = 4 * k, 4 * k + 4
            faces += [[low + a, low + b, high + b], [low + a, high + b, high + a]]
    for k in range(6):
        up = [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
        faces += up if k in (2, 5) else [face[::-1] for face in up]
    source = MeshSource(write_ply(tmp_path / "stack.ply", vertices, np.array(faces)))
    assert source.topology() == (2, 1)
    assert source.describe()["walls"] == 8
    assert "8 faces of the mesh are walls" in source.warnings()[0]
    assert enclosed_volume(source.vertices, source.triangles) == pytest.approx(6.0, rel=1e-9)
    # A hole in the outside is none of this.
    opened = MeshSource(write_ply(tmp_path / "open.ply", vertices, np.array(faces[1:])))
    assert opened.open_edges > 0
    assert opened.describe()["walls"] == 0


def test_a_point_in_common_leaves_two_parts(tmp_path: Path) -> None:
    source = MeshSource(write_ply(tmp_path / "point.ply", *cubes((0, 0, 0), (1, 1, 1))))
    assert source.topology() == (4, 2)


def test_the_distance_of_welding_can_be_given(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    soup = vertices[triangles.reshape(-1)]
    soup = soup + 1e-7 * np.random.default_rng(0).normal(size=soup.shape)
    slit = soup + np.where((np.arange(len(soup)) % 3 == 0)[:, None], [0, 0, 1e-3], 0)
    path = write_ply(tmp_path / "slit.ply", slit, np.arange(len(soup)).reshape(-1, 3))
    for reach, expected in ((None, None), (0.0, None), (2e-3, (2, 1))):
        source = MeshSource(path)
        source.reach = reach
        assert source.topology() == expected
        again = MeshSource(path)
        again.restore(source.state())  # what later stages see
        assert again.topology() == expected


def test_what_is_not_to_be_welded_is_not_in_later_stages(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    soup = vertices[triangles.reshape(-1)]
    soup = soup + 1e-7 * np.random.default_rng(0).normal(size=soup.shape)
    path = write_ply(tmp_path / "soup.ply", soup, np.arange(len(soup)).reshape(-1, 3))
    assert MeshSource(path).topology() == (2, 1)
    source, again = MeshSource(path), MeshSource(path)
    source.reach = 0.0
    again.restore(source.state())
    assert source.topology() is None
    assert again.topology() is None


def test_a_sheet_that_is_there_both_ways_is_no_solid(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    assert MeshSource(write_ply(tmp_path / "sheet.ply", corners, faces)).topology() is None


def test_a_common_face_cut_along_other_diagonals_is_left_out(tmp_path: Path) -> None:
    source = MeshSource(write_ply(tmp_path / "touch.ply", *cubes((0, 0, 0), (1, 0, 0))))
    assert source.topology() == (2, 1)
    assert enclosed_volume(source.vertices, source.triangles) == pytest.approx(2)
    # No face is left between the two.
    middle = source.vertices[source.triangles].mean(axis=1)
    assert (np.abs(middle[:, 0] - 1) > 1e-6).all()


def figure_of_eight() -> tuple[np.ndarray, np.ndarray]:
    """A closed tube along a curve that crosses itself once."""
    turns, sides = 48, 16
    angle = np.linspace(0, 2 * np.pi, turns, endpoint=False)
    curve = np.stack([np.sin(angle), np.sin(2 * angle) / 2, 0 * angle], axis=1)
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    side = np.cross(along, [0, 0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    around = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rings = np.cos(around)[None, :, None] * side[:, None] + np.stack(
        [0 * around, 0 * around, np.sin(around)], axis=1
    )
    ring, spoke = (part.ravel() for part in np.indices((turns, sides)))
    number = ring * sides + spoke
    up, right = (ring + 1) % turns * sides - ring * sides, (spoke + 1) % sides - spoke
    corners = np.stack([number, number + up, number + up + right, number + right])
    return (
        (curve[:, None] + 0.15 * rings).reshape(-1, 3),
        np.concatenate([corners[[0, 1, 2]].T, corners[[0, 2, 3]].T]),
    )


def test_a_part_that_crosses_itself_is_what_it_encloses(tmp_path: Path) -> None:
    vertices, triangles = figure_of_eight()
    source = MeshSource(write_ply(tmp_path / "eight.ply", vertices, triangles))
    # A tube is a torus; where it crosses itself it has two loops.
    assert topology(PolygonMesh.of_triangles(vertices, triangles)).euler_number == 0
    assert source.topology() == (-2, 1)
    assert source.describe()["folded_parts"] == 1
    assert any("that cross themselves: 1" in warning for warning in source.warnings())
    crossing = enclosed_volume(vertices, triangles)
    # Volume that is counted twice where two cylinders cross at an angle of 90 degrees.
    assert enclosed_volume(source.vertices, source.triangles) == pytest.approx(
        crossing - 16 / 3 * 0.15**3, rel=0.02
    )
    assert source.inside(np.zeros((1, 3))).all()


def test_what_classify_found_is_not_found_again(tmp_path: Path) -> None:
    for name, mesh in (("eight", figure_of_eight()), ("ball", sphere_mesh())):
        first = MeshSource(write_ply(tmp_path / f"{name}.ply", *mesh))
        again = MeshSource(first.path)
        again.restore(first.state())
        assert again.__dict__["united"] is None
        assert np.array_equal(again.vertices, first.vertices)
        assert np.array_equal(again.triangles, first.triangles)
        assert again.topology() == first.topology()


def test_what_no_solid_can_be_made_of_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(crossing_child, "SECONDS", 0.01)
    source = MeshSource(write_ply(tmp_path / "eight.ply", *figure_of_eight()))
    assert source.topology() == (0, 1)  # that of the file
    assert source.describe()["folded_parts"] == 0
    assert any("no solid can be made of them" in said for said in source.warnings())
