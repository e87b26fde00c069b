"""Edge lengths: thin parts, close creases, errors, a number of faces, refinement."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import Cli, fibonacci, random_rotation, sphere_mesh, surface_of, write_obj
from hypothesis import given, settings
from hypothesis import strategies as st

from vorolight.stages.inputs.creases.sharp_edges import of_triangles
from vorolight.stages.mesh.creases import Creases
from vorolight.stages.mesh.edge_table import EdgeTable, Sized
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.queries.thickness import FLAT, ROUND
from vorolight.stages.mesh.topology import topology
from vorolight.stages.remesh.curvature_metric import LONGEST, metrics
from vorolight.stages.remesh.fitting import backward, forward, vertex_errors
from vorolight.stages.remesh.length_field import GRADATION, LengthField, evened, separation
from vorolight.stages.remesh.operations import delaunay_gain, split_long
from vorolight.stages.remesh.remeshing import divide
from vorolight.stages.remesh.target_lengths import (
    Spacing,
    TooManyTriangles,
    _affordable,
    limits,
    spaced,
)
from vorolight.stages.training.refinement import Refine, refined
from vorolight.stages.training.spheres import Spheres


def egg(level: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A long ellipsoid, 16 by 4 by 4, much more curved at its ends than at its sides."""
    vertices, triangles = sphere_mesh(1.0, level)
    return vertices * [8.0, 2.0, 2.0], triangles


def rounded(level: int) -> tuple[np.ndarray, np.ndarray]:
    """A cube of side 8 with round edges."""
    vertices, triangles = sphere_mesh(1.0, level)
    return 4 * vertices / (vertices**8).sum(axis=1)[:, None] ** (1 / 8), triangles


def rms(mesh: Sized, surface: object) -> float:
    ways = [way(surface, mesh.vertices, mesh.triangles) for way in (forward, backward)]
    return float(np.sqrt(sum(rows.share @ rows.distance(mesh.vertices) ** 2 for rows in ways)))


def test_creases_across_from_each_other_are_close_and_those_around_a_corner_are_not() -> None:
    along = np.linspace(0, 10, 101)
    line = np.stack([along, 0 * along, 0 * along], axis=1)
    way = np.tile([1.0, 0.0, 0.0], (101, 1))
    both = np.concatenate([line, line + np.array([0, 0.4, 0])])
    found = separation(both, np.concatenate([way, way]), 2.0)
    assert found == pytest.approx(0.4)
    # At a right angle every way between the two goes along one of them, or obliquely.
    other, turned = line[:, [1, 0, 2]], way[:, [1, 0, 2]]
    corner = separation(np.concatenate([line, other]), np.concatenate([way, turned]), 2.0)
    assert np.isinf(corner).all()
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    tangent = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    # Nearest across a circle are the points at which both tangents have a cosine of a half.
    assert separation(ring, tangent, 3.0) == pytest.approx(2 * np.cos(np.radians(30)), rel=0.02)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), rise=st.floats(0.1, 3.0))
def test_lengths_are_graded_whatever_is_asked_for(seed: int, rise: float) -> None:
    random = np.random.default_rng(seed)
    points = fibonacci(400, 3.0)
    wanted = np.exp(random.normal(0, rise, 400))
    field = LengthField(points, wanted)
    assert (field.lengths <= wanted).all()
    assert field.lengths.min() == wanted.min()
    here, there, limit = field.edges
    assert (field.lengths[here] <= field.lengths[there] + limit + 1e-3 * wanted.min()).all()
    assert limit == pytest.approx(GRADATION * np.linalg.norm(points[here] - points[there], axis=1))


def test_lengths_even_the_errors_out() -> None:
    lengths = np.array([1.0, 1.0, 2.0])
    # Squared error over a triangle, in its area: 64 times as much, half the length.
    assert evened(lengths, np.array([64.0, 1.0, 0.25])) == pytest.approx(
        lengths * (22.0 / np.array([64.0, 1.0, 1.0])) ** (1 / 6)
    )
    assert (evened(lengths, np.zeros(3)) == lengths).all()


@pytest.mark.parametrize("faces", [500, 3000])
def test_a_number_of_faces_is_met(faces: int, tmp_path: Path) -> None:
    shape = egg()
    surface = surface_of(tmp_path / "egg.ply", shape)
    mesh, _ = spaced(*egg(4), surface, None, Spacing(0.55, faces=faces))
    assert len(mesh.triangles) == pytest.approx(faces, rel=0.05)  # as --faces-target says
    found = topology(PolygonMesh.of_triangles(mesh.vertices, mesh.triangles))
    assert (found.closed, found.euler_number) == (True, 2)


def test_varied_lengths_follow_the_surface_better(tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "cube.ply", rounded(6))
    even, _ = spaced(*rounded(4), surface, None, Spacing(0.8, 0.8, 0.8))
    varied, _ = spaced(*rounded(4), surface, None, Spacing(0.55, faces=len(even.triangles)))
    assert len(varied.triangles) == pytest.approx(len(even.triangles), rel=0.03)
    second = np.sort(np.abs(varied.vertices), axis=1)[:, 1]
    # Edges of the cube are round, its sides are flat.
    assert varied.length[second > 3.4].mean() < 0.6 * varied.length[second < 2].mean()
    assert rms(varied, surface) < 0.85 * rms(even, surface)


def test_lengths_keep_to_their_limits(tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "egg.ply", egg())
    mesh, _ = spaced(*egg(4), surface, None, Spacing(0.55, 0.4, 0.9))
    assert mesh.length.min() >= 0.4 * (1 - 1e-12)
    assert mesh.length.max() <= 0.9 * (1 + 1e-12)
    assert mesh.length.max() > 0.6  # the sides need less than the default


def test_thin_parts_get_shorter_edges_down_to_any_thickness() -> None:
    turn = random_rotation(3)
    for thin in (0.5, 0.05):
        plate = trimesh.creation.box((8.0, 8.0, thin))
        points, most = limits(plate.vertices @ turn.T, plate.faces, None, 2.0, 0.1, 0.6, 0.03)
        inner = np.abs(points @ turn)[:, :2].max(axis=1) < 3
        assert most[inner] == pytest.approx(FLAT * thin, rel=1e-3)
    rod = trimesh.creation.cylinder(0.25, 8.0, 64)
    points, most = limits(rod.vertices @ turn.T, rod.faces, None, 2.0, 0.1, 0.6, 0.03)
    inner = np.abs(points @ turn)[:, 2] < 3
    # A tube turns within its thickness: as many edges around it as around a thick one.
    assert most[inner] == pytest.approx(ROUND * 0.5, rel=0.05)


def test_towards_the_edge_of_a_wedge_lengths_have_a_floor() -> None:
    angle = np.radians(20)
    outline = np.array([[0, 0, 0], [8, 0, 0], [8 * np.cos(angle), 8 * np.sin(angle), 0]])
    wedge = trimesh.convex.convex_hull(np.concatenate([outline, outline + np.array([0, 0, 8])]))
    creases = Creases(of_triangles(wedge.vertices, wedge.faces, 40.0))
    points, most = limits(wedge.vertices, wedge.faces, creases, 1.0, 0.15, 0.6, 0.03)
    assert most[: len(points) - len(creases.dense)].min() == pytest.approx(0.15)
    middle = (np.abs(points[:, 0] - 3) < 0.2) & (np.abs(points[:, 2] - 4) < 2)
    assert np.isfinite(most[middle]).all()


def test_what_would_take_too_many_triangles_is_refused_at_its_thinnest_place(
    tmp_path: Path,
) -> None:
    box = trimesh.creation.box((8.0, 8.0, 8.0))
    slit = trimesh.creation.box((4.0, 9.0, 0.05)).apply_translation((3.0, 0, 0))
    cut = trimesh.boolean.difference([box, slit])
    surface = surface_of(tmp_path / "slit.ply", (cut.vertices, cut.faces))
    spacing = Spacing(0.55, most=5000)
    with pytest.raises(TooManyTriangles) as caught:
        spaced(cut.vertices, cut.faces, surface, None, spacing, True)
    assert caught.value.demand.triangles > 20_000
    # Beside its rims, where it turns.
    assert caught.value.demand.lengths == pytest.approx(ROUND * 0.05, rel=0.01)
    assert np.abs(caught.value.demand.places[:, 2]) == pytest.approx(0.025)


def test_folds_of_a_first_surface_are_not_taken_for_thin_parts(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(3.0, 3)
    surface = surface_of(tmp_path / "ball.ply", (vertices, triangles))
    random = np.random.default_rng(0)
    first = vertices + 0.15 * random.normal(size=vertices.shape)
    assert limits(first, triangles, None, 0.8, 0.2, 0.6, 0.03)[1].min() < 0.5
    mesh, _ = spaced(first, triangles, surface, None, Spacing(0.8))
    assert mesh.length == pytest.approx(0.8)


def test_an_inputs_own_triangles_are_divided_without_a_vertex_moved(tmp_path: Path) -> None:
    box = trimesh.creation.box((8.0, 0.3, 0.1))
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces)
    surface = surface_of(tmp_path / "rod.ply", (vertices, triangles))
    mesh = Sized(vertices, triangles, np.full(8, 0.2))
    divide(mesh, lambda points: np.full(len(points), 0.2), surface)
    assert {tuple(at) for at in vertices} <= {tuple(at) for at in mesh.vertices}
    off = np.abs(np.abs(mesh.vertices) - [4.0, 0.15, 0.05]).min(axis=1)
    assert off.max() < 1e-12
    longest = EdgeTable.of(mesh.triangles).lengths(mesh.vertices).max()
    assert longest <= 0.2 * 4 / 3
    # Halving alone would leave long thin triangles, and many more of them.
    halved = Sized(vertices, triangles, np.full(8, 0.2))
    while split_long(halved):
        halved.length = np.full(len(halved.vertices), 0.2)
    assert len(mesh.triangles) < 0.6 * len(halved.triangles)


def test_only_what_is_too_far_is_divided(tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "egg.ply", egg())
    start, _ = spaced(*egg(4), surface, None, Spacing(0.8, 0.8, 0.8))
    spheres = Spheres.at(start)
    _, far = vertex_errors(surface, spheres.centres, spheres.triangles)
    bound = 0.5 * far.max()
    further = refined(spheres, surface, None, Refine(bound))
    assert further is not None
    after, free = further
    _, left = vertex_errors(surface, after.centres, after.triangles)
    assert left.max() < 0.8 * far.max()
    assert free.mean() < 0.65
    still = {tuple(at) for at in spheres.centres[np.abs(spheres.centres[:, 0]) < 2]}
    assert still <= {tuple(at) for at in after.centres[~free]}
    assert len(EdgeTable.of(after.triangles).ends) == 3 * len(after.triangles) // 2
    assert len(after.radii) == len(after.centres) == len(after.age) == len(free)
    assert refined(spheres, surface, None, Refine(1.01 * far.max())) is None
    most = len(spheres.triangles) + 20
    less, _ = refined(spheres, surface, None, Refine(bound, most)) or (spheres, None)
    assert len(spheres.triangles) < len(less.triangles) < len(after.triangles)
    assert refined(spheres, surface, None, Refine(bound, len(spheres.triangles))) is None


@pytest.mark.slow
def test_faces_and_refinement_of_a_run(tmp_path: Path, cli: Cli) -> None:
    write_obj(tmp_path / "egg.obj", *egg(4))
    done = cli("init", "egg.obj", "-n", 14, "--iterations", 10, cwd=tmp_path)
    assert done.returncode == 0, done.stderr

    def trained(*words: object) -> dict:
        done = cli("sphere-train", *words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        record = json.loads((tmp_path / "egg.vorolight" / "sphere-train.json").read_text())
        mesh = trimesh.load(tmp_path / "egg.vorolight" / "sphere-train.ply", process=False)
        assert mesh.is_watertight
        assert len(mesh.faces) == record["metrics"]["trained_faces"]
        assert record["metrics"]["certificate"]["holds"]
        return record

    faces = trained("--faces-target", 700)["metrics"]["trained_faces"]
    assert faces == pytest.approx(700, rel=0.05)
    record = trained("--edge-length", 1.2, "--refine", 0.02)
    assert record["metrics"]["refinement"]["within"]
    assert record["metrics"]["refinement"]["rounds"] >= 1
    assert record["warnings"] == []
    record = trained("--edge-length", 1.2, "--refine", 0.001, "--faces-target", 600)
    assert record["metrics"]["trained_faces"] <= 600
    assert any("raise --faces-target or --refine" in said for said in record["warnings"])


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--spacing-min", "1", "--spacing-max", "0.5"], "more than --spacing-max"),
        (["--faces-target", "500", "--preset", "paper"], "not used with --preset paper"),
        (["--refine", "0.1", "--preset", "paper"], "not used with --preset paper"),
        (["--faces-target", "20"], "at least 100|from 100"),
    ],
)
def test_impossible_spacings_are_refused(
    words: list[str], reason: str, tmp_path: Path, cli: Cli
) -> None:
    done = cli("sphere-train", *words, "--run", "run", cwd=tmp_path)
    assert done.returncode == 2
    assert any(part in done.stderr for part in reason.split("|"))


def test_metrics_are_long_where_the_surface_bends_less() -> None:
    sphere = Sized(*sphere_mesh(3.0, 4), np.ones(2562))
    assert np.allclose(metrics(sphere), np.eye(3), atol=0.1)
    vertices, triangles = egg(5)
    turn = random_rotation(4)
    found = metrics(Sized(vertices @ turn.T, triangles, np.ones(len(vertices))))
    assert np.allclose(np.linalg.det(found), 1)
    assert np.allclose(found, found.transpose(0, 2, 1))
    # Around its middle the egg bends 16 times as much as along it, which counts as flat there.
    middle = np.abs(vertices[:, 0]) < 1
    along = np.einsum("vij,i,j->v", found[middle], turn[:, 0], turn[:, 0])
    assert (along < 0.7).all()
    assert (along > 0.99 / LONGEST).all()
    flat = Sized(vertices * [1e-9, 1, 1], triangles, np.ones(len(vertices)))
    assert np.isfinite(metrics(flat)).all()


def test_edges_are_measured_in_the_metric() -> None:
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.6, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    stretch = np.diag([0.5, 2.0, 1.0])
    mesh = Sized(corners, triangles, np.full(4, 0.7))
    mesh.metric = lambda at: np.broadcast_to(stretch @ stretch, (len(at), 3, 3))
    ends = np.array([[0, 1], [0, 2], [0, 0]])
    assert mesh.edge_target(ends) == pytest.approx([1.4, 0.35, 0.7])
    table = EdgeTable.of(triangles)
    straight = Sized(corners @ stretch, triangles, np.full(4, 0.7))
    assert delaunay_gain(mesh, table) == pytest.approx(delaunay_gain(straight, table))


def test_varied_triangles_are_longer_along_the_shape(tmp_path: Path) -> None:
    surface = surface_of(tmp_path / "egg.ply", egg())
    mesh, _ = spaced(*egg(4), surface, None, Spacing(0.55, faces=1500))
    table = EdgeTable.of(mesh.triangles)
    way = mesh.vertices[table.ends[:, 1]] - mesh.vertices[table.ends[:, 0]]
    middle = np.abs(mesh.vertices[table.ends].mean(axis=1)[:, 0]) < 4
    square = (way[middle] ** 2).mean(axis=0)
    # Of even triangles a third of the squares is each direction's, two on a cylinder's side.
    assert square[0] > 1.5 * (square[1] + square[2])


def test_close_creases_take_few_triangles_more() -> None:
    points = np.random.default_rng(0).uniform(0, 8, (4000, 3)) * [1, 1, 0]
    field = LengthField(points, np.full(4000, 0.5))
    for creases, low, high in ((50, 0.03, 0.06), (2000, 0.1, 0.2)):
        most = np.full(4000, 0.5)
        most[-creases:] = 0.01
        raised = _affordable(field, most, 4000 - creases, (0.03, 0.2), 64.0)
        lengths = field.graded(np.maximum(raised, 0.03))
        # Few get much of what they ask for, many next to nothing.
        assert low <= lengths.min() <= high
