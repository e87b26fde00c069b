"""Tubes, plates, shells, and the checks of prints: on shapes whose answers are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import random_rotation, sphere_mesh
from hypothesis import given
from hypothesis import strategies as st
from manifold3d import Manifold

from vorolight.stages.errors import UsageError
from vorolight.stages.fabrication import (
    assembly,
    base,
    layers,
    plates,
    printability,
    printcheck,
    solid,
    tubes,
)
from vorolight.stages.fabrication.even_cells import even_cells
from vorolight.stages.formats import stl, threemf
from vorolight.stages.mesh.geometry import face_frames
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.solids import solid_of
from vorolight.stages.mesh.topology import topology

BALL = PolygonMesh.of_triangles(*sphere_mesh(30.0, 1))


def graph_of(mesh: PolygonMesh) -> tuple[tubes.TubeGraph, np.ndarray]:
    graph = tubes.tube_graph(mesh, 0.1)
    return graph, np.ones(len(graph.nodes))


def polygon(corners: np.ndarray) -> PolygonMesh:
    """One face ``corners (N, 2)`` in a plane that is tilted."""
    flat = np.column_stack([corners, np.zeros(len(corners))]) @ random_rotation(3).T
    return PolygonMesh(flat, np.array([0, len(corners)]), np.arange(len(corners)))


@pytest.mark.parametrize("fillet", [False, True])
def test_tubes_of_a_graph_have_its_genus(fillet: bool) -> None:
    graph, radii = graph_of(BALL)
    assert (len(graph.nodes), len(graph.tubes), graph.loops) == (42, 120, 79)
    body = assembly.union(tubes.tubes(graph, radii, 8, fillet))
    assert assembly.handles(body) == graph.loops
    part = assembly.largest(body)
    assert part.genus == graph.loops
    assert part.dropped_parts == 0
    two = tubes.TubeGraph(
        np.concatenate([graph.nodes, graph.nodes + 90]),
        np.concatenate([graph.tubes, graph.tubes + 42]),
        graph.faces,
        graph.face_sources,
    )
    assert two.loops == 2 * graph.loops
    twice = assembly.union(tubes.tubes(two, np.ones(84), 8))
    assert assembly.handles(twice) == two.loops


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


def test_tapered_tubes_are_measured_as_they_are() -> None:
    graph, _ = graph_of(BALL)
    radii = tubes.tapered(graph.nodes, 1.5, 0.4)
    assert radii[graph.nodes[:, 2].argmin()] == pytest.approx(1.5)
    assert radii[graph.nodes[:, 2].argmax()] == pytest.approx(0.6)
    part = assembly.largest(assembly.union(tubes.tubes(graph, radii, 12)))
    points = printability.axis_points(graph, lambda at: np.ones(len(at), bool))
    (check,) = printability.wall(
        part.vertices.astype(float), part.triangles, points, np.zeros((0, 3)), 0.8, 0.4, 0.2
    )
    assert check.verdict == "ok"
    # The thinnest axis point lies a tenth along a tube from the highest node.
    assert 1.2 <= check.value <= 1.45
    (check,) = printability.wall(
        part.vertices.astype(float), part.triangles, points, np.zeros((0, 3)), 0.8, 0.9, 0.2
    )
    assert check.verdict == "fail"


def test_short_edges_are_welded() -> None:
    vertices = BALL.vertices.copy()
    a, b = BALL.face_vertices[:2]
    vertices[b] = vertices[a] + 0.01
    graph = tubes.tube_graph(BALL.with_vertices(vertices), 0.5)
    assert len(graph.nodes) == 41
    assert len(graph.tubes) == 120 - 3  # the edge, and one of two pairs on either side
    assert graph.faces.face_count == 78
    assert len(graph.face_sources) == 78


@pytest.mark.parametrize("pattern", ["random", "even", "height", "checker"])
def test_plates(pattern: str) -> None:
    chosen = plates.choose(BALL, 0.25, pattern, np.random.default_rng(0))
    assert len(np.unique(chosen)) == 20
    bodies = plates.plates(BALL, chosen, 1.0)
    area, _, centre = face_frames(BALL)
    volumes = np.array([body.volume() for body in bodies])
    assert volumes == pytest.approx(area[chosen] * 1.0, rel=1e-6)
    gaps = np.linalg.norm(centre[chosen][:, None] - centre[chosen], axis=2) + 99 * np.eye(20)
    if pattern == "even":  # 20 of 80 faces: none beside another, whose centres are 8 to 11 apart
        assert gaps.min() > 11
    if pattern == "height":
        assert centre[chosen, 2].mean() < -8


def test_a_lamp_does_not_fall_dark() -> None:
    chosen = plates.choose(BALL, 1.0, "random", np.random.default_rng(0))
    area, _, _ = face_frames(BALL)
    assert plates.DARK <= 1 - area[chosen].sum() / area.sum() < plates.DARK + 0.02


def test_openings_of_known_faces() -> None:
    square = polygon(np.array([[0, 0], [4, 0], [4, 4], [0, 4]], float))
    assert plates.openings(square, np.full(4, 0.5)) == pytest.approx([1.5])
    assert plates.openings(square, np.full(4, 2.5)) == pytest.approx([-0.5])
    angles = np.arange(6) * np.pi / 3
    hexagon = polygon(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    assert plates.openings(hexagon, np.zeros(6)) == pytest.approx([np.sqrt(3) / 2])


@given(seed=st.integers(0, 2**32 - 1))
def test_openings_are_the_largest_circles(seed: int) -> None:
    random = np.random.default_rng(seed)
    angles = np.sort(random.uniform(0, 2 * np.pi, random.integers(5, 11)))
    corners = np.stack([2 * np.cos(angles), np.sin(angles)], axis=1)
    found = plates.openings(polygon(corners), np.zeros(len(corners)))[0]
    following = np.roll(corners, -1, axis=0)
    normal = np.stack([following[:, 1] - corners[:, 1], corners[:, 0] - following[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = random.uniform(corners.min(axis=0), corners.max(axis=0), (4000, 2))
    depth = ((corners[None] - points[:, None]) * normal).sum(axis=2).min(axis=1)
    assert depth.max() <= found + 1e-9
    # Four thousand points come within a twentieth of the polygon's size of the centre.
    assert depth.max() >= found - 0.15


def test_a_shell_is_nowhere_thinner_than_asked() -> None:
    ball = PolygonMesh.of_triangles(*sphere_mesh(30.0, 3))
    body, distances = solid.shell(ball, 2.0)
    assert distances.min() >= 2.0
    outside = solid_of(ball).volume()
    hollow = outside - body.volume()
    # Half a grid cell further in than asked: 60 / 128 / 2.
    assert hollow == pytest.approx(4 / 3 * np.pi * (30 - 2 - 0.235) ** 3, rel=0.02)
    with pytest.raises(UsageError, match="no part of the shape is that thick"):
        solid.shell(ball, 31.0)


def box(size: tuple[float, float, float], at: tuple[float, float, float]) -> Manifold:
    return Manifold.cube(size).translate(at)


def test_a_fine_tip_is_no_empty_layer_but_a_gap_is() -> None:
    tip = Manifold.cylinder(30, 10, 0.01, 32)
    gap = box((20, 20, 1), (-10, -10, 0)) + box((20, 20, 1), (-10, -10, 3))
    for body, expected in ((tip, 0), (gap, 4)):
        mesh = body.to_mesh()
        found = layers.islands(
            np.array(mesh.vert_properties), np.array(mesh.tri_verts, np.int64), 0.5, 0.4
        )
        assert found.empty_layers == expected


def test_the_air_is_no_island() -> None:
    spread = Manifold.cylinder(30, 5, 60, 64).to_mesh()
    found = layers.islands(
        np.array(spread.vert_properties), np.array(spread.tri_verts, np.int64), 0.5, 0.4
    )
    assert len(found.areas) == 0


def test_a_part_that_hangs_on_a_narrow_strip_is_no_island() -> None:
    box = Manifold.cube
    for offset in (0.0, 0.2):
        # The strip is half as wide as the nozzle: the centres of the grid miss one of the two.
        strip = box([16, 0.2, 1]).translate([4, 2.3 + offset, 1])
        body = box([5, 5, 2]) + strip + box([4, 4, 1]).translate([18, 0.5, 1])
        mesh = body.to_mesh()
        found = layers.islands(
            np.asarray(mesh.vert_properties[:, :3], float), np.asarray(mesh.tri_verts), 0.5, 0.4
        )
        assert len(found.areas) == 0
    apart = (box([5, 5, 2]) + box([4, 4, 1]).translate([18, 0.5, 1])).to_mesh()
    found = layers.islands(
        np.asarray(apart.vert_properties[:, :3], float), np.asarray(apart.tri_verts), 0.5, 0.4
    )
    assert found.areas == pytest.approx([16], rel=0.02)


def test_islands_and_layers() -> None:
    post, arm = box((10, 10, 40), (0, 0, 0)), box((30, 10, 5), (0, 0, 35))
    tooth = box((4, 3, 20), (25, 3, 18))
    plain = assembly.largest(post + arm)
    found = layers.islands(plain.vertices.astype(float), plain.triangles, 0.5, 0.4)
    assert (found.layers, found.empty_layers, len(found.areas)) == (80, 0, 0)
    toothed = assembly.largest(post + arm + tooth)
    found = layers.islands(toothed.vertices.astype(float), toothed.triangles, 0.5, 0.4)
    assert len(found.areas) == 1
    assert found.places[0] == pytest.approx([27, 4.5, 18.25], abs=0.3)
    assert found.areas[0] == pytest.approx(12, rel=0.2)


@given(seed=st.integers(0, 2**32 - 1))
def test_layers_have_the_sections_area(seed: int) -> None:
    body = Manifold.sphere(8.0, 24).rotate(tuple(np.random.default_rng(seed).uniform(0, 90, 3)))
    body -= box((6, 4, 30), (-2, -3, -15))
    part = assembly.largest(body)
    pitch, heights = 0.1, np.arange(-7.0, 7.5, 2.0)
    vertices = part.vertices.astype(float)
    for z, mask, _ in layers.sections(vertices, part.triangles, heights, pitch):
        # The rim is 60 mm long at most, and a cell on it may count either way.
        assert mask.sum() * pitch**2 == pytest.approx(body.slice(z).area(), abs=60 * pitch / 2)


def test_overhangs_of_a_mushroom() -> None:
    part = assembly.largest(box((10, 10, 20), (-5, -5, 0)) + box((30, 30, 2), (-15, -15, 20)))
    check = printability.overhangs(part.vertices.astype(float), part.triangles)
    area = 2 * 900 + 4 * 30 * 2 + 4 * 10 * 20
    assert check.value == pytest.approx((900 - 100) / area, abs=1e-4)
    assert check.verdict == "warn"


def test_bridges_and_floating_starts() -> None:
    nodes = np.array([[0, 0, 0], [0, 0, 20], [12, 0, 20], [12, 0, 0], [6, 0, 9], [0, 0, 9]], float)
    ends = np.array([[0, 5], [5, 1], [1, 2], [2, 3], [4, 1]])
    graph = tubes.TubeGraph(nodes, ends, BALL, np.zeros(0, np.int64))
    every = lambda at: np.ones(len(at), bool)  # noqa: E731
    check = printability.bridges(graph, every)
    assert (check.verdict, check.value) == ("warn", 12.0)
    assert check.worst[0] == [6.0, 0.0, 20.0]
    check = printability.floating(graph, lambda at: at[:, 2] > 1)
    assert check.value == 1
    assert check.worst == [[6.0, 0.0, 9.0]]


def test_the_bed() -> None:
    assert printability.bed((200, 100, 50), (110, 210, 60)).verdict == "ok"
    assert printability.bed((200, 120, 50), (110, 210, 60)).verdict == "fail"
    assert printability.bed((200, 100, 70), (110, 210, 60)).verdict == "fail"


def test_open_files_are_found_out(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh()
    small = vertices.astype(np.float32)
    for faces, fault in (
        (triangles[1:], "watertight"),
        (triangles[:, ::-1], "inward"),
        (np.concatenate([triangles, triangles + len(small)]), "2 separate"),
    ):
        path = tmp_path / "a.stl"
        path.write_bytes(stl.encode(np.concatenate([small, small + 9]), faces))
        assert fault in (printcheck.check(path).fault() or "")


def test_3mf_holds_its_bodies_and_is_the_same_each_time(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(20.0)
    bodies = [
        threemf.Body(name, (vertices + shift).astype(np.float32), triangles)
        for name, shift in (("lamp", 0.0), ("lid", 50.0))
    ]
    data = threemf.encode(bodies, "a ball", "vorolight")
    assert data == threemf.encode(bodies, "a ball", "vorolight")
    assert data != threemf.encode(bodies, "another", "vorolight")
    for found, wanted in zip(threemf.read(data), bodies, strict=True):
        assert found.name == wanted.name
        assert np.array_equal(found.triangles, wanted.triangles)
        assert np.allclose(found.vertices, wanted.vertices, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match=r"."):
        threemf.read(data[: len(data) // 2])
    path = tmp_path / "a.3mf"
    path.write_bytes(data)
    assert printcheck.check(path).fault(2) is None


def test_nodes_in_hollows_are_raised() -> None:
    """A chain that goes up, down into a hollow and up again; a deep hollow is left alone."""
    heights = np.array([0.0, 3.0, 2.0, 2.5, 4.0, 9.0, 1.0, 9.5])
    nodes = np.column_stack([np.arange(8.0), np.zeros(8), heights])
    chain = np.stack([np.arange(7), np.arange(1, 8)], axis=1)
    none = PolygonMesh(nodes, np.zeros(1, np.int64), np.zeros(0, np.int64))
    graph = tubes.TubeGraph(nodes, chain, none, np.zeros(0, np.int64))
    found = tubes.raised(graph, 0.0, 2.0).nodes
    assert found[:, :2] == pytest.approx(nodes[:, :2])
    assert found[[0, 1, 4, 5, 6, 7], 2].tolist() == heights[[0, 1, 4, 5, 6, 7]].tolist()
    assert 3.0 < found[2, 2] < found[3, 2] < 3.1
    assert (tubes.raised(graph, 2.6, 2.0).nodes == nodes).all()  # what stands on the floor stays


def test_even_cells_have_the_size_that_is_asked_for() -> None:
    """On a ball whose own faces are a fifth as wide, and on one whose faces are wider."""
    for level in (4, 1):
        ball = PolygonMesh.of_triangles(*sphere_mesh(10.0, level))
        found = even_cells(ball, 3.0, 1)
        facts = topology(found)
        assert facts.closed
        assert facts.euler_number == 2
        # A hexagon of this width has the area sqrt(3) / 2 times its square.
        area = face_frames(found)[0].sum()
        assert facts.faces == pytest.approx(area / (np.sqrt(3) / 2 * 3.0**2), rel=0.25)
        assert (np.bincount(found.face_vertices) == 3).all()


def test_a_few_sealed_faces_are_no_warning() -> None:
    places = np.zeros((3, 3))
    assert printability.sealed(places, np.zeros(3), 300).verdict == "ok"
    assert printability.sealed(places, np.zeros(3), 299).verdict == "warn"


def test_balance() -> None:
    square = np.array([[-10, -10], [10, -10], [10, 10], [-10, 10]], float)
    assert base.balance(np.array([0, 0, 10]), square).tilt_degrees == pytest.approx(45)
    assert base.balance(np.array([12, 0, 10]), square).tilt_degrees < 0
    top = Manifold.cube((40, 10, 10)).translate((0, -5, 20))
    leaning = Manifold.cube((10, 10, 30)).translate((0, -5, 0)) + top
    centre = np.array([16.0, 0.0, 22.0])
    slab, widened = base.foot(leaning, centre)
    assert widened
    assert base.balance(centre, base.footprint(slab)).tilt_degrees >= base.TILT
