"""Files, read back by other libraries."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import sphere_mesh

from vorolight.stages.formats import ply, stl
from vorolight.stages.mesh.geometry import enclosed_volume, fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.render import image_file, raster
from vorolight.stages.voronoi.diagram.interface import interface


def polygons() -> PolygonMesh:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    return interface(points, np.linalg.norm(points, axis=1) < 0.6).mesh


def test_ply_round_trip_with_data(tmp_path: Path) -> None:
    mesh = polygons()
    plain = ply.decode(ply.encode(mesh, {"quality": np.arange(mesh.vertex_count) * 1.0}))
    assert plain is not None
    assert np.array_equal(plain.vertices, mesh.vertices)
    assert np.array_equal(plain.face_vertices, mesh.face_vertices)
    vtk = pytest.importorskip("vtk")
    path = tmp_path / "a.ply"
    path.write_bytes(ply.encode(mesh))
    reader = vtk.vtkPLYReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetOutput().GetNumberOfPolys() == mesh.face_count
    split = vtk.vtkTriangleFilter()
    split.SetInputConnection(reader.GetOutputPort())
    mass = vtk.vtkMassProperties()
    mass.SetInputConnection(split.GetOutputPort())
    mass.Update()
    ours = enclosed_volume(*fan_triangles(mesh)[:2])
    # VTK keeps the points of a PLY in single precision.
    assert mass.GetVolume() == pytest.approx(ours, rel=1e-4)


def test_ply_of_others() -> None:
    head = (
        "ply\nformat {}\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    )
    text = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 2 1\n"
    ascii_mesh = ply.decode((head.format("ascii 1.0") + text).encode())
    big = b"".join(struct.pack(">3f", *map(float, line.split())) for line in text.split("\n")[:4])
    big += struct.pack(">B4i", 4, 0, 1, 2, 3) + struct.pack(">B3i", 3, 0, 2, 1)
    binary = ply.decode(head.format("binary_big_endian 1.0").encode() + big)
    for mesh in (ascii_mesh, binary):
        assert mesh is not None
        assert mesh.face_offsets.tolist() == [0, 4, 7]
        assert mesh.face_vertices.tolist() == [0, 1, 2, 3, 0, 2, 1]
        assert mesh.vertices[2].tolist() == [1, 1, 0]


def test_stl_is_read_by_trimesh(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh()
    path = tmp_path / "a.stl"
    path.write_bytes(stl.encode(vertices.astype(np.float32), triangles))
    import trimesh

    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(enclosed_volume(vertices, triangles), rel=1e-5)


def test_vtu_is_read_by_vtk(heart_run: Path, manifest: Callable[[str], dict[str, Any]]) -> None:
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(heart_run / "volume.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    metrics = manifest("volume")["metrics"]
    assert grid.GetNumberOfCells() == metrics["cells"]
    assert {grid.GetCellType(i) for i in range(grid.GetNumberOfCells())} == {42}
    recorded = grid.GetCellData().GetArray("volume")
    total = 0.0
    for index in range(grid.GetNumberOfCells()):
        cell = grid.GetCell(index)
        volume = 0.0
        for number in range(cell.GetNumberOfFaces()):
            points = cell.GetFace(number).GetPoints()
            ring = np.array([points.GetPoint(i) for i in range(points.GetNumberOfPoints())])
            face = PolygonMesh.of_triangles(ring, np.arange(len(ring))[None])
            corners, triangles, _ = fan_triangles(face)
            a, b, c = (corners[triangles[:, k]] for k in range(3))
            volume += np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        assert volume == pytest.approx(recorded.GetValue(index), rel=1e-6, abs=1e-12)
        total += volume
    assert total == pytest.approx(metrics["enclosed_volume"], rel=1e-9)


def test_picture_of_a_sphere(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 4)
    camera = raster.view("z")
    seen = raster.rasterize(vertices, triangles, camera, 200, 200)
    radius = 0.46 * 200
    assert (seen.triangle >= 0).sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    assert seen.depth.max() == pytest.approx(1, abs=0.01)
    image = raster.shaded(
        vertices, triangles, np.arange(len(triangles)), np.ones(3), camera, 64, 64
    )
    data = image_file.png(image)
    path = tmp_path / "a.png"
    path.write_bytes(data)
    assert data.startswith(b"\x89PNG")
    pillow = pytest.importorskip("PIL.Image")
    with pillow.open(path) as opened:
        assert opened.size == (64, 64)
        assert np.array_equal(np.asarray(opened), np.rint(image * 255).astype(np.uint8))


def test_nearer_triangles_hide_others() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1.0]])
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    camera = raster.View(np.array([0.0, 0, 1]), np.array([0.0, 1, 0]))
    seen = raster.rasterize(vertices, triangles, camera, 50, 50)
    assert set(np.unique(seen.triangle)) == {-1, 1}
    from_below = raster.View(np.array([0.0, 0, -1]), np.array([0.0, 1, 0]))
    assert (raster.rasterize(vertices, triangles, from_below, 50, 50).triangle == -1).all()
