"""``vorolight export``: every format read back, parts, and what is refused."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from conftest import Cli

from vorolight.cli.export import FORMATS as SHOWN
from vorolight.stages.formats.registry import FORMATS
from vorolight.stages.mesh.geometry import enclosed_volume, fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh


@pytest.fixture(scope="module")
def exported(
    heart_run: Path, cli: Cli, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Path]:
    """Export the run of the heart under a name, once."""
    folder = tmp_path_factory.mktemp("exported")

    def write(name: str, *words: object) -> Path:
        if not (folder / name).exists():
            done = cli("export", folder / name, "--run", heart_run, *words, cwd=folder)
            assert done.returncode == 0, done.stderr
        return folder / name

    return write


def test_formats_in_the_help_are_those_there_are() -> None:
    assert SHOWN.split("|") == list(FORMATS)


def test_foam_case_is_the_mesh(exported: Callable[..., Path], heart_run: Path) -> None:
    case = exported("case", "--format", "openfoam") / "constant" / "polyMesh"

    def listed(name: str) -> list[str]:
        body = (case / name).read_text().split("}\n", 1)[1]
        count, rest = body.strip().split("\n", 1)
        rows = rest.strip().strip("()").strip().splitlines()
        assert len(rows) == int(count)
        return rows

    points = np.array([[float(x) for x in row.strip("()").split()] for row in listed("points")])
    owner, neighbour = (np.array(listed(name), int) for name in ("owner", "neighbour"))
    faces = [np.array(re.findall(r"\d+", row)[1:], int) for row in listed("faces")]
    with h5py.File(heart_run / "volume.h5") as file:
        assert np.array_equal(points, file["vertices"][:])
        assert np.array_equal(owner, file["face_owner"][:])
        assert np.array_equal(np.concatenate(faces), file["face_vertices"][:])
        volumes = file["cell_volume"][:]
    inner = len(neighbour)
    assert (owner[:inner] < neighbour).all()
    assert (np.diff(owner[:inner] * len(volumes) + neighbour) > 0).all()
    boundary = (case / "boundary").read_text()
    assert f"startFace {inner};" in boundary
    assert f"nFaces {len(owner) - inner};" in boundary
    # Gauss: area vectors of a cell add up to nothing.
    sums = np.zeros((len(volumes), 3))
    for number, face in enumerate(faces):
        ring = points[face]
        area = 0.5 * np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0)
        sums[owner[number]] += area
        if number < inner:
            sums[neighbour[number]] -= area
    assert np.abs(sums).max() < 1e-12


def test_a_case_that_is_there_is_kept_but_for_its_mesh(
    exported: Callable[..., Path], heart_run: Path, cli: Cli, tmp_path: Path
) -> None:
    case = tmp_path / "case"
    shutil.copytree(exported("case", "--format", "openfoam"), case)
    (case / "system" / "fvSchemes").write_text("mine")
    words = ["export", case, "--format", "openfoam", "--run", heart_run]
    done = cli(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert "with --force" in done.stderr
    (case / "constant" / "polyMesh" / "points").write_text("broken")
    assert cli(*words, "--force", cwd=tmp_path).returncode == 0
    assert (case / "system" / "fvSchemes").read_text() == "mine"
    assert (case / "constant" / "polyMesh" / "points").stat().st_size > 100
    assert sorted(path.name for path in (case / "constant").iterdir()) == ["polyMesh"]


def test_tetrahedra_fill_the_surface(
    exported: Callable[..., Path], manifest: Callable[[str], dict[str, Any]]
) -> None:
    metrics = manifest("volume")["metrics"]
    msh, inp = (meshio.read(exported(name)) for name in ("heart.msh", "heart.inp"))
    for mesh in (msh, inp):
        corners = mesh.points[mesh.cells_dict["tetra"]]
        a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
        volume = np.einsum("ij,ij->i", np.cross(a, b), c) / 6
        assert volume.min() > 0
        assert volume.sum() == pytest.approx(metrics["enclosed_volume"], rel=1e-9)
    assert len(msh.cells_dict["triangle"]) >= metrics["boundary_faces"]
    assert set(msh.field_data) == {"volume", "surface"}
    boundary = np.unique(msh.cells_dict["triangle"])
    assert np.array_equal(np.sort(inp.point_sets["surface"]), boundary)


def test_files_for_paraview(
    exported: Callable[..., Path], manifest: Callable[[str], dict[str, Any]]
) -> None:
    vtk = pytest.importorskip("vtk")
    metrics = manifest("volume")["metrics"]

    def read(path: Path) -> Any:
        reader = vtk.vtkXMLUnstructuredGridReader()
        reader.SetFileName(str(path))
        reader.Update()
        return reader.GetOutput()

    whole, part = read(exported("heart.vtu")), read(exported("part.vtu", "--cut", "x>0.1"))
    names = {whole.GetCellData().GetArrayName(k) for k in range(7)}
    assert names == {
        "generator", "role", "volume", "faces", "non_orthogonality", "skewness", "aspect",
    }  # fmt: skip
    assert whole.GetNumberOfCells() == metrics["cells"]
    assert 0.1 * metrics["cells"] < part.GetNumberOfCells() < 0.9 * metrics["cells"]
    assert part.GetBounds()[0] > whole.GetBounds()[0] + 0.5
    tetrahedra = read(exported("tetrahedra.vtu", "--format", "vtu-tetrahedra"))
    assert {tetrahedra.GetCellType(k) for k in range(5)} == {10}
    assert tetrahedra.GetCellData().GetArray("role").GetRange() == (1.0, 2.0)


def test_a_part_is_closed(exported: Callable[..., Path]) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    with h5py.File(exported("half.h5", "--cut", "z<0.2")) as file:
        volume, owner = file["cell/volume"][:].sum(), file["face_owner"][:]
        neighbour = file["face_neighbour"][:]
    inner = int((neighbour >= 0).sum())
    assert (neighbour[inner:] == -1).all()
    assert owner.max() + 1 == len(np.unique(owner))
    reader = vtk.vtkPLYReader()
    reader.SetFileName(str(exported("half.ply", "--cut", "z<0.2")))
    reader.Update()
    found = reader.GetOutput()
    assert found.GetNumberOfPolys() == len(owner) - inner
    cells = found.GetPolys()
    offsets, corners = (
        vtk_to_numpy(array).astype(np.int64)
        for array in (cells.GetOffsetsArray(), cells.GetConnectivityArray())
    )
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(float)
    mesh = PolygonMesh(points, offsets, corners)
    ahead = mesh.face_vertices * len(points) + mesh.next_vertices
    behind = mesh.next_vertices * len(points) + mesh.face_vertices
    assert np.array_equal(np.sort(ahead), np.sort(behind))  # cells may touch at an edge only
    # VTK reads PLY in single precision.
    assert enclosed_volume(*fan_triangles(mesh)[:2]) == pytest.approx(volume, rel=1e-5)


def test_ovm_cells_are_closed(exported: Callable[..., Path], heart_run: Path) -> None:
    words = exported("heart.ovm").read_text().split("\n")
    assert words[0] == "OVM ASCII"
    parts, at = {}, 1
    while at < len(words) and words[at]:
        name, count = words[at], int(words[at + 1])
        parts[name] = [list(map(float, row.split())) for row in words[at + 2 : at + 2 + count]]
        at += 2 + count
    edges = np.array(parts["Edges"], int)

    def start(half: int) -> int:
        return int(edges[half // 2][half % 2])

    faces = [[int(h) for h in row[1:]] for row in parts["Faces"]]
    for face in faces:
        for half, after in zip(face, [*face[1:], face[0]], strict=True):
            assert start(half ^ 1) == start(after)  # a ring
    points = np.array(parts["Vertices"])
    for row in parts["Polyhedra"][:40]:
        used: list[int] = []
        volume = 0.0
        for half_face in map(int, row[1:]):
            face = faces[half_face // 2]
            ring = [start(half) for half in face]
            turned = half_face % 2 == 1
            used += [half ^ turned for half in face]
            corners = points[ring[::-1] if turned else ring]
            a, b, c = corners[0], corners[1:-1], corners[2:]
            volume += np.cross(b, c).dot(a).sum() / 6
        assert sorted(half ^ 1 for half in used) == sorted(used)  # every edge both ways
        assert volume < 0  # half-faces face into the cell


def test_export_says_what_is_wrong(heart_run: Path, cli: Cli, tmp_path: Path) -> None:
    for words, said, code in (
        (["a.xyz"], "no format has that suffix", 2),
        (["a.vtu", "--format", "abc"], "must be one of", 2),
        (["a.vtu", "--cut", "w=1"], "must be like x=0.1", 2),
        (["a.vtu", "--cut", "x<-90"], "no cell lies there; x goes from", 3),
        ([".", "--format", "vtu"], "is a folder", 2),
    ):
        done = cli("export", *words, "--run", heart_run, cwd=tmp_path)
        assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
        assert said in done.stderr
    assert list(tmp_path.iterdir()) == []
