"""The certificate: a conforming surface has it, and each way of breaking one is named."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import random_rotation, sphere_mesh, torus_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.artifacts.hdf5 import read
from vorolight.stages.errors import NumericalFailure
from vorolight.stages.formats import ply
from vorolight.stages.mesh import spheres as mesh_spheres
from vorolight.stages.mesh.edge_table import Sized
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology
from vorolight.stages.metrics.watertight import as_written
from vorolight.stages.training.spheres import Spheres
from vorolight.stages.voronoi import certificate
from vorolight.stages.voronoi.certificate import Certificate, certify


@dataclass(frozen=True)
class Case:
    mesh: PolygonMesh
    radii: np.ndarray
    generators: np.ndarray
    inside: np.ndarray
    pairs: np.ndarray

    def certificate(self) -> Certificate:
        return certify(self.mesh, self.radii, self.generators, self.inside, self.pairs)


def case_of(vertices: np.ndarray, triangles: np.ndarray, radius: float) -> Case:
    """Equal spheres at the vertices of triangles, and the pairs where they meet."""
    spheres = Spheres.at(Sized(vertices, triangles, np.ones(len(vertices))))
    spheres = replace(spheres, radii=np.full(len(vertices), radius))
    points, square = spheres.generators()
    assert (square > 0).all()
    count = len(triangles)
    return Case(
        PolygonMesh.of_triangles(vertices, triangles),
        spheres.radii,
        np.concatenate([points[count:], points[:count]]),
        np.arange(2 * count) < count,
        np.stack([np.arange(count), count + np.arange(count)], axis=1),
    )


@pytest.fixture
def sphere() -> Case:
    return case_of(*sphere_mesh(4.0, 2), 1.2)


def test_a_conforming_sphere_has_it(sphere: Case) -> None:
    found = sphere.certificate()
    assert found.holds
    assert found.failed == ()
    assert found.incident_power < 1e-13
    assert found.margin > 0.01


def test_a_file_has_the_topology_that_was_certified(tmp_path: Path, sphere: Case) -> None:
    path = tmp_path / "surface.ply"
    path.write_bytes(ply.encode(sphere.mesh))
    found = as_written({"ply": path}, topology(sphere.mesh))
    assert (found["euler_number"], found["components"]) == (2, 1)
    assert found["certified_topology"]
    assert not as_written({"ply": path})["certified_topology"]
    torus = topology(PolygonMesh.of_triangles(*torus_mesh(3.0, 1.0, 16, 8)))
    with pytest.raises(NumericalFailure, match="Euler number 2 and 1 components"):
        as_written({"ply": path}, torus)


@pytest.mark.parametrize("size", [0.05, 0.4, 4.0])
def test_the_margin_is_that_of_all_generators(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many generators lie within half a voxel of a sphere, few of them are looked at."""
    monkeypatch.setattr(mesh_spheres, "AT_ONCE", 50)
    case = case_of(*sphere_mesh(size, 2), 0.3 * size)
    mesh, count = case.mesh, case.mesh.vertex_count
    squared = ((case.generators[:, None] - mesh.vertices) ** 2).sum(axis=2) - case.radii**2
    own = np.zeros(squared.shape, dtype=bool)
    for side in case.pairs.T:
        own[side[mesh.corner_faces], mesh.face_vertices] = True
    least = squared[~own].min()
    assert case.certificate().margin == pytest.approx(min(least, certificate.REACH**2), rel=1e-9)
    found = certificate._other_powers(mesh, case.radii, case.generators, case.pairs, threads=1)
    assert len(found) < 10 * count


@given(st.integers(0, 10**6))
def test_it_does_not_depend_on_the_frame(seed: int) -> None:
    vertices, triangles = sphere_mesh(4.0, 2)
    vertices = vertices + 0.1 * np.sin(2 * vertices[:, [1, 2, 0]])
    turn, shift = random_rotation(seed), np.random.default_rng(seed).normal(size=3)
    there = case_of(vertices @ turn.T + shift, triangles, 1.2).certificate()
    here = case_of(vertices, triangles, 1.2).certificate()
    assert here.holds
    assert there.holds
    assert here.margin == pytest.approx(there.margin, abs=1e-9)


def test_a_moved_generator(sphere: Case) -> None:
    moved = sphere.generators.copy()
    moved[7] += [0.01, 0, 0]
    found = replace(sphere, generators=moved).certificate()
    assert "incident" in found.failed


def test_a_swapped_pair(sphere: Case) -> None:
    swapped = sphere.generators.copy()
    swapped[sphere.pairs[3]] = swapped[sphere.pairs[3, ::-1]]
    found = replace(sphere, generators=swapped).certificate()
    assert set(found.failed) == {"orientation", "winding"}
    assert found.turned_faces == 1
    assert found.wound_wrongly == 2


def test_a_swapped_label(sphere: Case) -> None:
    inside = sphere.inside.copy()
    inside[sphere.pairs[3]] = inside[sphere.pairs[3, ::-1]]
    assert set(replace(sphere, inside=inside).certificate().failed) == {"orientation", "winding"}


def test_a_reversed_ring(sphere: Case) -> None:
    triangles = sphere.mesh.face_vertices.reshape(-1, 3).copy()
    triangles[5] = triangles[5, ::-1]
    mesh = PolygonMesh.of_triangles(sphere.mesh.vertices, triangles)
    found = replace(sphere, mesh=mesh).certificate()
    assert {"rings", "orientation"} <= set(found.failed)
    assert found.turned_faces == 1


def test_a_deleted_face(sphere: Case) -> None:
    keep = np.arange(sphere.mesh.face_count) != 11
    found = replace(
        sphere, mesh=sphere.mesh.select_faces(keep), pairs=sphere.pairs[keep]
    ).certificate()
    assert "rings" in found.failed
    assert found.bad_rings == 3


def test_an_unpaired_generator_inside_a_sphere(sphere: Case) -> None:
    more = np.concatenate([sphere.generators, 0.97 * sphere.mesh.vertices[:1]])
    found = replace(sphere, generators=more, inside=np.append(sphere.inside, True)).certificate()
    assert found.failed == ("exclusion",)


def test_unpaired_generators_elsewhere_by_their_side(sphere: Case) -> None:
    more = np.concatenate([sphere.generators, [[0.0, 0.0, 0.0]]])
    right = replace(sphere, generators=more, inside=np.append(sphere.inside, True))
    wrong = replace(right, inside=np.append(sphere.inside, False))
    assert right.certificate().holds
    assert wrong.certificate().failed == ("winding",)


def test_a_nested_sphere_of_the_same_orientation(sphere: Case) -> None:
    inner = case_of(*sphere_mesh(1.5, 2), 0.45)
    vertices, count = sphere.mesh.vertex_count, len(sphere.generators)
    both = Case(
        PolygonMesh.of_triangles(
            np.concatenate([sphere.mesh.vertices, inner.mesh.vertices]),
            np.concatenate([
                sphere.mesh.face_vertices.reshape(-1, 3),
                vertices + inner.mesh.face_vertices.reshape(-1, 3),
            ]),
        ),
        np.concatenate([sphere.radii, inner.radii]),
        np.concatenate([sphere.generators, inner.generators]),
        np.concatenate([sphere.inside, inner.inside]),
        np.concatenate([sphere.pairs, count + inner.pairs]),
    )  # fmt: skip
    assert both.certificate().failed == ("winding",)


def cube() -> tuple[Case, np.ndarray]:
    """A regular polygon surface that conforms: a cube, and its corner spheres all through its
    centre's mirror images."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    rings = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                      [1, 5, 7, 3]])  # fmt: skip
    mesh = PolygonMesh.of_triangles(corners, rings)
    outside = 2 * corners[rings].mean(axis=1)
    generators = np.concatenate([np.zeros((1, 3)), outside])
    pairs = np.stack([np.zeros(6, np.int64), 1 + np.arange(6)], axis=1)
    return Case(mesh, np.full(8, np.sqrt(3)), generators, np.arange(7) == 0, pairs), rings


def test_polygons_that_share_a_generator() -> None:
    assert cube()[0].certificate().holds


def test_a_crossed_ring() -> None:
    case, rings = cube()
    rings[0, [1, 2]] = rings[0, [2, 1]]
    found = replace(case, mesh=PolygonMesh.of_triangles(case.mesh.vertices, rings)).certificate()
    assert "rings" in found.failed


def independent(vertices: np.ndarray, triangles: np.ndarray, inside: np.ndarray,
                outside: np.ndarray) -> int:  # fmt: skip
    """The certificate once more, from distances alone: spheres that are not empty or whose own
    generators are not on them."""
    points = np.concatenate([inside, outside])
    wrong = 0
    for v, centre in enumerate(vertices):
        own = np.flatnonzero((triangles == v).any(axis=1))
        own = np.concatenate([own, own + len(triangles)])
        distance = np.linalg.norm(points - centre, axis=1)
        others = np.delete(distance, own)
        wrong += np.ptp(distance[own]) > 1e-9 or others.min() <= distance[own].max() + 1e-7
    return int(wrong)


def trained(run: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    arrays = read(run / "sphere-train.h5", "sphere-train")[0]
    return (
        arrays["surface/vertices"], arrays["surface/face_vertices"].reshape(-1, 3),
        arrays["generators/inside"], arrays["generators/outside"],
    )  # fmt: skip


def test_the_heart_as_written_by_an_independent_check(heart_run: Path) -> None:
    assert independent(*trained(heart_run)) == 0


def test_voro_finds_the_same_interface(heart_run: Path) -> None:
    import pyvoro2

    vertices, triangles, inside, outside = trained(heart_run)
    points = np.concatenate([inside, outside])
    low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
    box = pyvoro2.Box(tuple(zip(low, high, strict=True)))
    count = len(triangles)
    found, area = set(), 0.0
    for cell in pyvoro2.compute(points, domain=box, output="cells"):
        if cell["id"] >= count:
            continue
        corners = np.asarray(cell["vertices"])
        for face in cell["faces"]:
            if face["adjacent_cell"] < count:
                continue
            ring = corners[face["vertices"]]
            fan = np.cross(ring[1:-1] - ring[0], ring[2:] - ring[0]).sum(axis=0)
            size = 0.5 * float(np.linalg.norm(fan))
            if size > 1e-9:  # roundoff leaves slivers where many cells meet in a vertex
                found.add((cell["id"], face["adjacent_cell"] - count))
                area += size
    assert found == {(f, f) for f in range(count)}
    at = vertices[triangles]
    own = 0.5 * np.linalg.norm(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]), axis=1).sum()
    assert area == pytest.approx(own, rel=1e-6)
