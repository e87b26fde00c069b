"""Gates of an evaluation on surfaces that are damaged on purpose, and thresholds of the user's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from conftest import sphere_mesh, torus_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

from vorolight.stages.errors import UsageError
from vorolight.stages.formats import ply
from vorolight.stages.mesh.polygons import Floats, Ints, PolygonMesh
from vorolight.stages.mesh.queries.intersections import self_intersections
from vorolight.stages.mesh.subdivision import subdivided
from vorolight.stages.mesh.topology import topology
from vorolight.stages.metrics import gates
from vorolight.stages.metrics.requirements import Requirement

Cli = Callable[..., "CompletedProcess[str]"]
Surface = tuple[Floats, Ints]


def sound() -> Surface:
    return sphere_mesh(1.0, 3)


def hole() -> Surface:
    vertices, triangles = sound()
    return vertices, np.delete(triangles, 7, axis=0)


def flipped() -> Surface:
    vertices, triangles = sound()
    triangles[7] = triangles[7, ::-1]
    return vertices, triangles


def pinched() -> Surface:
    """Two spheres that share their nearest vertex."""
    vertices, triangles = sound()
    right = int(np.argmax(vertices[:, 0]))
    other = vertices * [-1, 1, 1] + [2 * vertices[right, 0], 0, 0]
    more = triangles[:, ::-1] + len(vertices)
    more[more == right + len(vertices)] = right
    return np.concatenate([vertices, other]), np.concatenate([triangles, more])


def crossing() -> Surface:
    """A spike is pushed through the other side."""
    vertices, triangles = sound()
    vertices[11] *= -1.2
    return vertices, triangles


def fin() -> Surface:
    """A triangle stands on an edge."""
    vertices, triangles = sound()
    new = [*triangles[7, :2], len(vertices)]
    return np.concatenate([vertices, [[2.0, 2, 2]]]), np.concatenate([triangles, [new]])


def inward() -> Surface:
    vertices, triangles = sound()
    return vertices, triangles[:, ::-1]


DAMAGE: dict[str, tuple[Callable[[], Surface], str, str]] = {
    "hole": (hole, "closed", "edges in one face only: 3 ("),
    "flipped": (flipped, "oriented", "turned against each other: 3 ("),
    "pinched": (pinched, "vertices_manifold", "vertices whose faces form more than one fan: 1 ("),
    "crossing": (crossing, "free_of_self_intersections", "pairs of faces that cross"),
    "fin": (fin, "edges_manifold", "edges in more than two faces: 1 ("),
    "inward": (inward, "outward", "the faces point inward"),
}


@pytest.fixture(scope="module")
def ball_run(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """A run of a sphere of which only classify is done."""
    folder = tmp_path_factory.mktemp("gates")
    write(folder / "ball.ply", sound())
    done = cli("classify", "ball.ply", "-n", 8, "-q", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


def write(path: Path, surface: Surface) -> Path:
    path.write_bytes(ply.encode(PolygonMesh.of_triangles(*surface)))
    return path


@pytest.mark.parametrize("name", DAMAGE)
def test_strict_fails_on_damaged_files_and_marks_the_elements(
    name: str, ball_run: Path, cli: Cli
) -> None:
    damage, gate, words = DAMAGE[name]
    vertices, triangles = damage()
    write(ball_run / f"{name}.ply", (vertices, triangles))
    run = ball_run / "ball.vorolight"
    command = ("evaluate", "--surface", f"{name}.ply", "--samples", 2000, "-q")
    done = cli(*command, "--strict", cwd=ball_run)
    assert done.returncode == 5, done.stderr
    *warnings, said = done.stderr.splitlines()
    assert f"file {name}.ply: " in said
    assert words in said
    assert all(line.startswith("warning: ") for line in warnings)
    found = json.loads((run / f"evaluate-file-{name}.json").read_text())["metrics"]
    assert found["gates"][gate] is False
    marked = run / f"evaluate-file-{name}.defects.ply"
    if name != "inward":
        assert str(marked.relative_to(ball_run)) in said
        part = ply_records(marked)
        assert part["face"]["defect"].max() >= 1
        # The numbers are those of the file.
        corners = triangles[part["face"]["face"].astype(int)]
        assert np.array_equal(part["vertex"]["xyz"][part["face"]["corners"]], vertices[corners])
    assert cli(*command, cwd=ball_run).returncode == 0


def ply_records(path: Path) -> dict[str, np.ndarray]:
    """The vertices and triangles of a PLY with two scalars each."""
    raw = path.read_bytes()
    head, _, body = raw.partition(b"end_header\n")
    counts = [int(line.split()[2]) for line in head.splitlines() if line.startswith(b"element")]
    vertex = np.dtype([("xyz", "<f8", 3), ("defect", "<f4"), ("vertex", "<f4")])
    face = np.dtype([("n", "u1"), ("corners", "<i4", 3), ("defect", "<f4"), ("face", "<f4")])
    at = counts[0] * vertex.itemsize
    return {
        "vertex": np.frombuffer(body, vertex, counts[0]),
        "face": np.frombuffer(body, face, counts[1], at),
    }


def test_a_sound_surface_passes_strictly_and_its_thresholds_decide(
    ball_run: Path, cli: Cli
) -> None:
    command = ("evaluate", "--surface", "ball.ply", "--samples", 2000, "-q", "--strict")
    done = cli(
        *command, "--require", "surface_cd2<1e-9", "--require", "euler_number==2", cwd=ball_run
    )
    assert done.returncode == 0, done.stderr
    run = ball_run / "ball.vorolight"
    assert not (run / "evaluate-file-ball.defects.ply").exists()
    found = json.loads((run / "evaluate-file-ball.json").read_text())["metrics"]
    assert found["gates"] == dict.fromkeys(
        ("closed", "edges_manifold", "vertices_manifold", "oriented", "outward",
         "free_of_self_intersections", "topology"), True,
    )  # fmt: skip
    done = cli(*command, "--require", "normal_consistency > 1.5", cwd=ball_run)
    assert done.returncode == 5
    assert "fidelity.normal_consistency is" in done.stderr
    assert "> 1.5 is required" in done.stderr
    for text, words in (
        ("f1=>2", 'is not of the form "f1>=0.98"'),
        ("f1>=many", "many is neither a number"),
        ("normal_consistancy>0", "no such figure; there is normal_consistency"),
        ("p95>0", "name one of curvature.p95"),
    ):
        done = cli(*command, "--require", text, cwd=ball_run)
        assert done.returncode == 2
        assert words in done.stderr


def test_topology_other_than_the_references_fails(ball_run: Path, cli: Cli) -> None:
    write(ball_run / "ring.ply", torus_mesh(0.8, 0.3, 32, 16))
    done = cli("evaluate", "--surface", "ring.ply", "--samples", 2000, "--strict", cwd=ball_run)
    assert done.returncode == 5
    assert "Euler number 0 and 1 components, where the reference has 2 and 1" in done.stderr


def test_references_that_do_not_fit_are_refused_or_warned_of(ball_run: Path, cli: Cli) -> None:
    vertices, triangles = sound()

    def measured(surface: Floats) -> CompletedProcess[str]:
        write(ball_run / "other.ply", (surface, triangles))
        return cli("evaluate", "--surface", "other.ply", "--samples", 2000, cwd=ball_run)

    done = measured(vertices + np.array([9, 0, 0]))
    assert done.returncode == 3
    assert "do not overlap" in done.stderr
    done = measured(1000 * vertices)
    assert done.returncode == 3
    assert "1000 times as large as this reference, so their units differ" in done.stderr
    done = measured(1.5 * vertices)
    assert done.returncode == 0
    assert "1.5 times as large as the reference ball" in done.stderr
    write(ball_run / "open.ply", hole())
    done = cli(
        "evaluate", "--surface", "ball.ply", "--reference", "open.ply", "--samples", 2000,
        cwd=ball_run,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "open.ply: the mesh has 1 opening with a flat edge" in done.stderr
    # Two openings at one vertex are not closed by caps.
    vertices, triangles = sound()
    around = np.flatnonzero((triangles == triangles[7, 0]).any(axis=1))
    apart = [k for k in around if len(np.intersect1d(triangles[k], triangles[7])) == 1]
    write(ball_run / "open.ply", (vertices, np.delete(triangles, [7, apart[0]], axis=0)))
    words = ("--surface", "ball.ply", "--reference", "open.ply", "--samples", 2000, "--strict")
    done = cli("evaluate", *words, cwd=ball_run)
    assert done.returncode == 0, done.stderr
    assert "open.ply has holes (6 edges in one triangle only)" in done.stderr
    assert "topology" in done.stdout
    assert "not known: the topology of the reference" in done.stdout


def test_self_intersections_of_known_arrangements() -> None:
    for surface in (sphere_mesh(1.0, 4), torus_mesh(1.0, 0.3, 48, 24)):
        assert len(self_intersections(*surface)) == 0
    vertices, triangles = sphere_mesh(1.0, 3)
    both = np.concatenate([triangles, triangles + len(vertices)])
    for way in ([1.0, 0, 0], [0.3, 0.2, 0.1]):
        # Along x the two are mirror images, so that edges meet edges.
        places = np.concatenate([vertices, vertices + way])
        found = self_intersections(places, both)
        middle = places[both[found]].mean(axis=(1, 2)) @ way / np.dot(way, way)
        assert len(found) > 30
        assert np.abs(middle - 0.5).max() < 0.5
        assert (found[:, 0] < len(triangles)).all()
        assert (found[:, 1] >= len(triangles)).all()
    twice = self_intersections(np.concatenate([vertices, vertices]), both)
    assert np.array_equal(twice[:, 1] - twice[:, 0], np.full(len(triangles), len(triangles)))
    # Two triangles at an edge: flat next to each other, and folded onto each other.
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, -1, 0], [0.9, 0.8, 0]])
    assert len(self_intersections(square, np.array([[0, 1, 2], [1, 0, 3]]))) == 0
    assert len(self_intersections(square, np.array([[0, 1, 2], [1, 0, 4]]))) == 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_self_intersections_do_not_depend_on_the_frame(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    vertices, triangles = random.normal(size=(12, 3)), random.permutation(12).reshape(4, 3)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    found = self_intersections(vertices, triangles)
    again = self_intersections(scale * vertices @ turn + random.normal(size=3), triangles)
    assert np.array_equal(found, again)
    # By the volumes of the tetrahedra that two triangles span.
    for a in range(4):
        for b in range(a):
            p, q = vertices[triangles[a]], vertices[triangles[b]]
            assert crosses(p, q) == ([b, a] in found.tolist())


def crosses(p: Floats, q: Floats) -> bool:
    def volume(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
        return float(np.linalg.det(np.stack([b - a, c - a, d - a])))

    for one, other in ((p, q), (q, p)):
        for i in range(3):
            a, b = one[i], one[(i + 1) % 3]
            if volume(*other, a) * volume(*other, b) > 0:
                continue
            sides = {volume(a, b, other[k], other[(k + 1) % 3]) > 0 for k in range(3)}
            if len(sides) == 1:
                return True
    return False


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 2.0))
def test_subdivision_keeps_the_surface(longest: float) -> None:
    vertices, triangles = torus_mesh(1.0, 0.4, 12, 7)
    found = subdivided(vertices, triangles, longest, 200_000)
    assert found is not None
    fine, parts = found
    corners = fine[parts]
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    assert edges.max() <= longest
    facts = topology(PolygonMesh.of_triangles(fine, parts))
    assert (facts.bad_edges, facts.pinched_vertices, facts.euler_number) == (0, 0, 0)
    area, volume = (
        (
            np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1).sum(),
            np.linalg.det(c).sum(),
        )
        for c in (vertices[triangles], corners)
    )
    assert area == pytest.approx(volume, rel=1e-12)
    assert subdivided(vertices, triangles, 1e-4, 10_000) is None


def test_defects_of_polygons_are_faces_not_their_triangles() -> None:
    # A cube with one corner pushed through the opposite side.
    cube = PolygonMesh(
        np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float),
        np.arange(7) * 4,
        np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]),
    )
    assert gates.defects(cube).count == 0
    places = cube.vertices.copy()
    places[7] = [-1.0, -0.6, -0.8]
    found = gates.defects(cube.with_vertices(places))
    assert len(found.crossing_faces)
    assert found.crossing_faces.max() < 6
    assert Requirement.parse("a>=1").fault({"a": None}) == "a is not known, but >= 1 is required"
    with pytest.raises(UsageError):
        Requirement.parse("a")
