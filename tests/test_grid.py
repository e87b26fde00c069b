"""Fields given by samples on a grid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import QUICK, Cli

from vorolight.stages.errors import InputError
from vorolight.stages.sources import grid_file
from vorolight.stages.sources.fields import FieldSource
from vorolight.stages.sources.grid import load
from vorolight.stages.sources.resolve import identify


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
        ("positive", np.ones((5, 5, 5)), "no sample is negative"),
        ("cut", -inside, "negative at the border"),
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
    assert "flat.npy: holds samples of shape (50, 3, 50)" in done.stderr


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


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n"
         b"data file: /etc/passwd\n\n", "another file"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 9999 9999 9999\n"
         b"encoding: gzip\n\nabc", "more than"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n\nabc",
         "readable"),
        ("a.nrrd", b"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nencoding: text\n"
         b"space directions: (1,1,0) (0,1,0) (0,0,1)\n\n" + b"1 " * 64, "axes"),
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
