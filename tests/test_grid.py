"""Fields given by samples on a grid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import QUICK, Cli

from vorolight.stages.errors import InputError
from vorolight.stages.formats import grid_file
from vorolight.stages.inputs.field.grid import load
from vorolight.stages.inputs.field.source import FieldSource
from vorolight.stages.inputs.resolve import identify


def ellipsoid(path: Path, count: int = 24) -> Path:
    """``x^2 + y^2 + (z/2)^2 - 1`` about (5, 0, 0), sampled with other steps along each axis."""
    steps = np.array([2.6, 2.8, 4.8]) / (count - 1)
    origin = np.array([5 - 1.3, -1.4, -2.4])
    x, y, z = (origin[k] + steps[k] * np.arange(count) for k in range(3))
    x, y, z = np.meshgrid(x, y, z, indexing="ij")
    values = (x - 5) ** 2 + y**2 + (z / 2) ** 2 - 1
    np.savez(path, values=values.astype(np.float32), origin=origin, spacing=steps)
    return path


def test_samples_are_interpolated_with_their_gradient(tmp_path: Path) -> None:
    source = FieldSource("e", path=ellipsoid(tmp_path / "e.npz"))
    field = source.field.formula
    low, high = source.bounding_box()
    assert np.allclose([low, high], [[3.7, -1.4, -2.4], [6.3, 1.4, 2.4]])
    points = low + 0.2 + np.random.default_rng(0).random((500, 3)) * (high - low - 0.4)
    x, y, z = (points - [5, 0, 0]).T
    # Of a quadratic only the reflection at the border is wrong, which fades by a factor of four a
    # sample; the samples are rounded to 1e-7.
    value, slope = source.gradient(points)
    assert np.allclose(value, x**2 + y**2 + z**2 / 4 - 1, atol=0.02)
    middle = np.abs(points - [5, 0, 0]).max(axis=1) < 0.5
    assert np.allclose(value[middle], (x**2 + y**2 + z**2 / 4 - 1)[middle], atol=1e-5)
    step = 1e-5
    for axis in range(3):
        ahead, behind = (points + sign * step * np.eye(3)[axis] for sign in (1, -1))
        numeric = (field(*ahead.T, np) - field(*behind.T, np)) / (2 * step)
        # Second derivatives are continuous: central differences are off by their square.
        assert np.allclose(slope[:, axis], numeric, atol=1e-6)
    samples = source.surface_samples(2000, np.random.default_rng(0))
    assert np.abs(source.value(samples)).max() < 1e-9
    far = np.array([[100.0, 0, 0], [5, 9, 9]])
    assert (source.value(far) > 1).all()
    assert not source.inside(far).any()
    # The compiled spline is torch's, to rounding, beyond the samples too.
    at = torch.tensor(np.concatenate([points, far, points + 2.0]), requires_grad=True)
    level = source.level(at)
    (expected,) = torch.autograd.grad(level.sum(), at)
    value, slope = source.gradient(at.detach().numpy())
    assert np.allclose(level.detach().numpy(), value, rtol=1e-12)
    assert np.allclose(expected.numpy(), slope, rtol=1e-9, atol=1e-12)


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load(path)


def test_files_that_hold_no_field(tmp_path: Path) -> None:
    inside = np.ones((6, 6, 6))
    inside[2:4, 2:4, 2:4] = -1
    for name, array, words in (
        ("flat", np.ones((5, 5)), "three dimensions"),
        ("thin", np.ones((5, 5, 3)), "three dimensions"),
        ("positive", np.ones((5, 5, 5)), "from 1 to 1: none is negative"),
        ("cut", -inside * np.arange(7.0, 13), "negative at the border"),
        ("nan", np.where(inside < 0, np.nan, inside), "8 samples are not finite"),
        ("text", np.full((5, 5, 5), "a"), "not numbers"),
        ("objects", np.full((5, 5, 5), None), "not a readable array"),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        refused(tmp_path / f"{name}.npy", words)
    np.savez(tmp_path / "other.npz", field=inside)
    refused(tmp_path / "other.npz", "no array called 'values'")
    np.savez(tmp_path / "steps.npz", values=inside, spacing=[1, -1, 1])
    refused(tmp_path / "steps.npz", "'spacing' positive")
    np.savez(tmp_path / "origin.npz", values=inside, origin=[1, 1])
    refused(tmp_path / "origin.npz", "three numbers")
    np.save(tmp_path / "whole.npy", inside)
    whole = (tmp_path / "whole.npy").read_bytes()
    for size in (0, 5, 40, 200, len(whole) - 1):
        (tmp_path / "part.npy").write_bytes(whole[:size])
        refused(tmp_path / "part.npy", "not a readable array")
    # A header that promises more than there is.
    (tmp_path / "part.npy").write_bytes(whole.replace(b"(6, 6, 6)", b"(9999,9999,9999)", 1))
    refused(tmp_path / "part.npy", "not a readable array")
    (tmp_path / "part.npz").write_bytes(b"PK" + whole)
    refused(tmp_path / "part.npz", "not a readable array")


def ball(count: int = 41, edge: float = 1.2) -> tuple[np.ndarray, float]:
    """Distances from the middle of a cube at samples within it, and their spacing."""
    at = np.linspace(-edge, edge, count)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    return np.sqrt(x**2 + y**2 + z**2), at[1] - at[0]


def test_inside_is_above_a_level(tmp_path: Path, cli: Cli) -> None:
    radius, step = ball()
    # As of a CT scan: air is 0, and what is dense is more than that.
    values = np.clip(3000 * (1.5 - 1.5 * radius), 0, 3000).astype(np.int16)
    np.savez(tmp_path / "ct.npz", values=values, spacing=step)
    refused(tmp_path / "ct.npz", "from 0 to 3000: none is negative.*--level 1.5e")
    with pytest.raises(InputError, match="none of them is above --level 3000"):
        load(tmp_path / "ct.npz", 3000.0)
    for level in (450.0, 1500.0):
        source = FieldSource("ct", path=tmp_path / "ct.npz", above=level)
        assert source.warnings() == []
        at = source.surface_samples(2000, np.random.default_rng(0)) - 1.2
        assert np.allclose(np.linalg.norm(at, axis=1), 1 - level / 4500, atol=0.05 * step)
    words = ["-n", 8, "--level", 450, "--until", "evaluate", *QUICK]
    done = cli("run", "ct.npz", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "ct.vorolight" / "evaluate-sphere-train.json").read_text())
    assert found["metrics"]["volume"] == pytest.approx(4 / 3 * np.pi * 0.9**3, rel=0.03)
    done = cli("classify", "sphere", "-n", 6, "--level", 1, cwd=tmp_path)
    assert done.returncode == 2
    assert "--level: needs samples on a grid" in done.stderr


def test_a_body_cut_off_by_the_grid_is_closed_and_said(tmp_path: Path) -> None:
    radius, step = ball(31, 0.7)
    np.savez(tmp_path / "cut.npz", values=1 - radius, origin=-0.7, spacing=step)
    with pytest.raises(InputError):
        load(tmp_path / "cut.npz")
    np.savez(tmp_path / "cut.npz", values=1 - radius, origin=[-0.7] * 3, spacing=step)
    refused(tmp_path / "cut.npz", "negative at the border")
    source = FieldSource("cut", path=tmp_path / "cut.npz", above=0.0)
    assert "cut off and closed" in source.warnings()[0]
    at = np.array([[0, 0, 0.7 + 0.2 * step], [0, 0, 0.7 + 0.8 * step], [0.65, 0.65, 0.65]])
    assert source.inside(at).tolist() == [True, False, False]
    assert (source.value(np.array([[0, 0, 0.7 + k * step] for k in range(1, 9)])) > 0).all()


def test_air_around_a_body_is_not_taken_for_it_in_silence(tmp_path: Path) -> None:
    radius, _ = ball()
    # Air is negative, as in Hounsfield units, and a layer of positive samples was added.
    np.save(tmp_path / "air.npy", np.pad(1000 * (1 - 2 * radius), 1, constant_values=5.0))
    assert (
        "so it may be the air around a body"
        in FieldSource("a", path=tmp_path / "air.npy").warnings()[0]
    )


@pytest.mark.parametrize("values", [(0, 1), (0, 255), (1, -1), (0, 7)])
def test_labels_become_a_smooth_surface(values: tuple[int, int], tmp_path: Path) -> None:
    radius, step = ball()
    labels = np.where(radius < 0.9, values[1], values[0]).astype(np.int16)
    if values == (0, 7):
        labels[(radius < 0.9) & (np.arange(41) > 20)] = 3
    path = tmp_path / "labels.npz"
    np.savez(path, values=labels, origin=[-1.2] * 3, spacing=step)
    source = FieldSource("labels", path=path)
    assert "the samples are labels" in source.warnings()[0]
    at = source.surface_samples(4000, np.random.default_rng(0))
    away = np.linalg.norm(at, axis=1)
    # Steps would be off by half a sample, and their normals by half a right angle.
    assert np.abs(away - 0.9).max() < 0.6 * step
    assert np.abs(away - 0.9).mean() < 0.2 * step
    assert abs(away.mean() - 0.9) < 0.05 * step
    _, slope = source.gradient(at)
    cosine = np.einsum("ij,ij->i", slope, at) / np.linalg.norm(slope, axis=1) / away
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 5
    # Every sample stays where it was, also in a wall of one sample.
    wall = np.zeros((20, 20, 20), np.uint8)
    wall[4:16, 4:16, 9] = 1
    np.save(tmp_path / "wall.npy", wall)
    thin = FieldSource("wall", path=tmp_path / "wall.npy")
    place = np.argwhere(np.ones(wall.shape, dtype=bool)).astype(float)
    assert (thin.inside(place) == wall.ravel().astype(bool)).all()


def test_a_run_of_samples(tmp_path: Path, cli: Cli) -> None:
    ellipsoid(tmp_path / "egg.npz")
    done = cli("run", "egg.npz", "-n", 10, "--until", "evaluate", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "egg.vorolight" / "evaluate-sphere-train.json").read_text())
    assert found["metrics"]["topology"]["euler_number"] == 2
    # Triangles of a coarse surface lie inside the ellipsoid.
    assert found["metrics"]["volume"] == pytest.approx(8 / 3 * np.pi, rel=0.06)
    done = cli("status", "egg.npz", cwd=tmp_path)
    assert "stale" not in done.stdout
    np.save(tmp_path / "flat.npy", np.zeros((50, 3, 50)))
    done = cli("classify", "flat.npy", cwd=tmp_path)
    assert done.returncode == 3
    assert "flat.npy: has samples of shape (50, 3, 50)" in done.stderr


def _vti(
    path: Path, values: np.ndarray, mode: str, compressed: bool, wide: bool, big: bool
) -> None:
    """Write with VTK; the extent does not begin at zero."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    a, b, c = values.shape
    image.SetExtent(2, 1 + a, 0, b - 1, -1, c - 2)
    image.SetOrigin(1, 2, 3)
    image.SetSpacing(0.5, 0.25, 2)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(order="F"), deep=True))
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    if mode == "text":
        writer.SetDataModeToAscii()
    elif mode == "binary":
        writer.SetDataModeToBinary()
    else:
        writer.SetDataModeToAppended()
        writer.SetEncodeAppendedData(mode == "appended")
    if compressed:
        writer.SetCompressorTypeToZLib()
        writer.SetBlockSize(48)
    else:
        writer.SetCompressorTypeToNone()
    (writer.SetHeaderTypeToUInt64 if wide else writer.SetHeaderTypeToUInt32)()
    (writer.SetByteOrderToBigEndian if big else writer.SetByteOrderToLittleEndian)()
    writer.Write()


@pytest.mark.parametrize("mode", ["text", "binary", "appended", "raw"])
@pytest.mark.parametrize("kind", ["f4", "f8", "i2"])
def test_vti_as_vtk_writes_it(tmp_path: Path, mode: str, kind: str) -> None:
    values = (10 * np.random.default_rng(0).standard_normal((5, 6, 7))).astype(kind)
    for number in range(8):
        compressed, wide, big = (bool(number & bit) for bit in (1, 2, 4))
        _vti(tmp_path / "a.vti", values, mode, compressed, wide, big)
        found = grid_file.read(tmp_path / "a.vti")
        # As text VTK writes single precision with fewer digits than it has.
        assert np.allclose(found.values, values, atol=1e-5 if mode == "text" else 0.0)
        assert np.allclose(found.origin, [2, 2, 1])
        assert np.allclose(found.spacing, [0.5, 0.25, 2])


@pytest.mark.parametrize("encoding", ["raw", "gzip", "ascii"])
@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "u1"])
def test_nrrd(tmp_path: Path, encoding: str, kind: str) -> None:
    import nrrd

    values = np.random.default_rng(0).integers(0, 100, (5, 6, 7)).astype(kind)
    header = {
        "encoding": encoding,
        "space": "left-posterior-superior",
        "space origin": [1, 2, 3],
        "space directions": np.diag([0.5, -0.25, 2.0]),
    }
    nrrd.write(str(tmp_path / "a.nrrd"), values, header)
    found = grid_file.read(tmp_path / "a.nrrd")
    # An axis that runs downward is turned.
    assert np.array_equal(found.values, values[:, ::-1])
    assert np.allclose(found.origin, [1, 2 - 5 * 0.25, 3])
    assert np.allclose(found.spacing, [0.5, 0.25, 2])


def test_axes_of_an_nrrd_in_another_order(tmp_path: Path) -> None:
    import nrrd

    values = np.random.default_rng(0).random((5, 6, 7))
    # The samples' first axis runs along z, the second down x, the third along y.
    directions = np.array([[0, 0, 2.0], [-0.5, 0, 0], [0, 0.25, 0]])
    header = {"space": "left-posterior-superior", "space origin": [1, 2, 3],
              "space directions": directions}  # fmt: skip
    nrrd.write(str(tmp_path / "a.nrrd"), values, header)
    found = grid_file.read(tmp_path / "a.nrrd")
    for index in ((0, 0, 0), (4, 5, 6), (1, 2, 3)):
        place = np.array([1, 2, 3]) + np.array(index) @ directions
        there = np.rint((place - found.origin) / found.spacing).astype(int)
        assert np.allclose(found.origin + found.spacing * there, place)
        assert found.values[tuple(there)] == values[index]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n"
         b"data file: gone.raw\n\n", "its data are in gone.raw, which does not exist"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 9999 9999 9999\n"
         b"encoding: gzip\n\nabc", "more than"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n\nabc",
         "readable"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: text\n"
         b"space directions: (1,1,0) (1,1,0) (0,0,1)\n\n" + b"1 " * 64, "axes lie in one plane"),
        ("a.vti", b"<VTKFile type='PolyData'/>", "no ImageData"),
        ("a.vti", b"<!DOCTYPE a [<!ENTITY b 'c'>]><VTKFile/>", "entities"),
        ("a.vti", b"<VTKFile type='ImageData'><ImageData><Piece/></ImageData></VTKFile>",
         "no scalars"),
    ],
)  # fmt: skip
def test_bad_grids(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        identify(str(path)).open().bounding_box()
    assert str(path) in str(error.value)
