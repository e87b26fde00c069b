"""Volumes in files: how their samples lie in space, and where they are."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from conftest import QUICK, Cli, random_rotation

from vorolight.stages.errors import InputError
from vorolight.stages.formats import grid_file
from vorolight.stages.formats.sample_grid import Samples
from vorolight.stages.inputs.field.grid import load
from vorolight.stages.inputs.field.source import FieldSource
from vorolight.stages.inputs.resolve import identify, kind_of

SHAPE = (14, 12, 10)
ORIGIN = np.array([12.0, -30.0, 55.0])
OBLIQUE = random_rotation(3) * [0.75, 1.0, 1.25]
PERMUTED = np.array([[0.0, -2, 0], [0, 0, 0.5], [1.5, 0, 0]])
SHEARED = np.array([[1.0, 0.25, 0], [0, 1, 0], [0, 0.125, 1.5]])


def values_at(points: np.ndarray) -> np.ndarray:
    """Other values at any two places: a wrong one cannot pass."""
    x, y, z = np.moveaxis(points - ORIGIN, -1, 0)
    return x + 3.1 * y - 2.3 * z + 0.01 * x * y * z


def samples(steps: np.ndarray, origin: np.ndarray = ORIGIN) -> np.ndarray:
    index = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    return values_at(origin + index @ steps.T)


def metaimage(
    path: Path, values: np.ndarray, steps: np.ndarray, place: str, extra: str = ""
) -> None:
    spacing = np.linalg.norm(steps, axis=0)
    kind = {"<f8": "MET_DOUBLE", ">f8": "MET_DOUBLE", "<i2": "MET_SHORT", "|u1": "MET_UCHAR"}
    header = (
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\n"
        f"BinaryDataByteOrderMSB = {values.dtype.byteorder == '>'}\n{extra}"
        f"TransformMatrix = {' '.join(map(repr, (steps / spacing).T.ravel().tolist()))}\n"
        f"Offset = {' '.join(map(repr, ORIGIN.tolist()))}\nCenterOfRotation = 0 0 0\n"
        f"ElementSpacing = {' '.join(map(repr, spacing.tolist()))}\n"
        f"DimSize = {' '.join(map(str, values.shape))}\n"
        f"ElementType = {kind[values.dtype.str]}\nElementDataFile = {place}\n"
    ).encode()
    flat = values.ravel(order="F").tobytes()
    if "CompressedData = True" in extra:
        flat = zlib.compress(flat)
    if place == "LOCAL":
        path.write_bytes(header + flat)
    else:
        path.write_bytes(header)
        path.with_name(place).write_bytes(flat)


def nrrd_header(steps: np.ndarray, shape: tuple[int, ...]) -> str:
    rows = " ".join(f"({','.join(map(repr, row))})" for row in steps.T.tolist())
    return (
        f"NRRD0004\ntype: double\ndimension: 3\nsizes: {' '.join(map(str, shape))}\n"
        f"space: left-posterior-superior\nspace directions: {rows}\nendian: little\n"
        f"space origin: ({','.join(map(repr, ORIGIN.tolist()))})\n"
    )


def mha(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    metaimage(path.with_suffix(".mha"), values, steps, "LOCAL")
    return path.with_suffix(".mha")


def mha_packed(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    found = values.astype(">f8")
    metaimage(path.with_suffix(".mha"), found, steps, "LOCAL", "CompressedData = True\n")
    return path.with_suffix(".mha")


def mhd(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    metaimage(path.with_suffix(".mhd"), values, steps, "volume.zraw", "CompressedData = True\n")
    return path.with_suffix(".mhd")


def nrrd(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    flat = values.ravel(order="F").tobytes()
    head = f"{nrrd_header(steps, values.shape)}encoding: raw\n\n".encode()
    path.with_suffix(".nrrd").write_bytes(head + flat)
    return path.with_suffix(".nrrd")


def nhdr(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    flat = b"two\nlines\n" + gzip.compress(b"1234" + values.ravel(order="F").tobytes())
    path.with_name("values.bin").write_bytes(flat)
    head = f"{nrrd_header(steps, values.shape)}encoding: gzip\nline skip: 2\nbyte skip: 4\n"
    path.with_suffix(".nhdr").write_text(f"{head}data file: values.bin\n")
    return path.with_suffix(".nhdr")


def nhdr_slices(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    for k in range(values.shape[2]):
        flat = values[:, :, k].ravel(order="F").tobytes()
        path.with_name(f"slice{k + 5:02}.raw").write_bytes(b"skipped" + flat)
    head = f"{nrrd_header(steps, values.shape)}encoding: raw\nbyte skip: -1\n"
    path.with_suffix(".nhdr").write_text(f"{head}data file: slice%02d.raw 5 14 1\n")
    return path.with_suffix(".nhdr")


def nhdr_list(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    nhdr_slices(path, values, steps)
    listed = "\n".join(f"slice{k + 5:02}.raw" for k in range(values.shape[2]))
    head = f"{nrrd_header(steps, values.shape)}encoding: raw\nbyte skip: 7\n"
    path.with_suffix(".nhdr").write_text(f"{head}data file: LIST\n{listed}\n")
    return path.with_suffix(".nhdr")


def mhd_list(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    nhdr_slices(path, values, steps)
    listed = "\n".join(f"slice{k + 5:02}.raw" for k in range(values.shape[2]))
    metaimage(path.with_suffix(".mhd"), values, steps, "LIST", "HeaderSize = 7\n")
    path.with_name("LIST").unlink()
    with path.with_suffix(".mhd").open("a") as file:
        file.write(listed)
    return path.with_suffix(".mhd")


def mhd_pattern(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    found = mhd_list(path, values, steps)
    found.write_text(found.read_text().split("LIST")[0] + "slice%02d.raw 5 14 1\n")
    return found


def nii(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, ORIGIN
    nibabel.save(nibabel.Nifti1Image(values, affine), path.with_suffix(".nii"))
    return path.with_suffix(".nii")


def nii_second(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, ORIGIN
    image = nibabel.Nifti2Image(values[..., None], affine)
    nibabel.save(image, path.with_suffix(".nii.gz"))
    return path.with_suffix(".nii.gz")


def nii_quaternion(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    image = nibabel.Nifti1Image(values, None)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, ORIGIN
    image.set_qform(affine, 1)
    image.set_sform(None, 0)
    nibabel.save(image, path.with_suffix(".nii"))
    return path.with_suffix(".nii")


def vti(path: Path, values: np.ndarray, steps: np.ndarray) -> Path:
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    image, spacing = vtk.vtkImageData(), np.linalg.norm(steps, axis=0)
    # The first sample has the index (2, 0, -1).
    image.SetExtent(2, 1 + values.shape[0], 0, values.shape[1] - 1, -1, values.shape[2] - 2)
    image.SetOrigin(*(ORIGIN - steps @ [2, 0, -1]))
    image.SetSpacing(*spacing)
    image.SetDirectionMatrix(*(steps / spacing).ravel())
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(order="F"), deep=True))
    point = np.array(image.TransformContinuousIndexToPhysicalPoint(2, 0, -1, [0.0, 0, 0]) or ORIGIN)
    assert np.allclose(point, ORIGIN)
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName(str(path.with_suffix(".vti")))
    writer.SetInputData(image)
    writer.Write()
    return path.with_suffix(".vti")


WRITERS = {
    write.__name__: write
    for write in (
        mha, mha_packed, mhd, mhd_list, mhd_pattern, nrrd, nhdr, nhdr_slices, nhdr_list, nii,
        nii_second, nii_quaternion, vti,
    )
}  # fmt: skip
Writer = Callable[[Path, np.ndarray, np.ndarray], Path]


def places(found: Samples) -> np.ndarray:
    index = np.stack(np.meshgrid(*map(np.arange, found.values.shape), indexing="ij"), axis=-1)
    return np.asarray(found.origin + (index * found.spacing) @ found.axes.T)


@pytest.mark.parametrize(
    "steps", [OBLIQUE, PERMUTED, SHEARED], ids=["oblique", "turned", "sheared"]
)
@pytest.mark.parametrize("name", sorted(WRITERS))
def test_samples_lie_where_the_file_says(name: str, steps: np.ndarray, tmp_path: Path) -> None:
    if steps is SHEARED and name == "nii_quaternion":
        pytest.skip("quaternions do not shear")
    path = WRITERS[name](tmp_path / "volume", samples(steps), steps)
    assert kind_of(path) == "field"
    found = grid_file.read(path)
    assert found.values.size == np.prod(SHAPE)
    assert np.allclose(values_at(places(found)), found.values, atol=1e-3)
    assert np.allclose(np.linalg.norm(found.axes, axis=0), 1)
    if steps is PERMUTED:
        # No spline has to be turned.
        assert np.array_equal(found.axes, np.eye(3))
        assert np.allclose(found.spacing, [2, 0.5, 1.5])


def test_a_turned_field_has_the_gradient_of_its_values(tmp_path: Path) -> None:
    path = mha(tmp_path / "a", samples(OBLIQUE), OBLIQUE)
    field = load(path, -20.0)
    source = FieldSource("a", path=path, above=-20.0)
    middle = ORIGIN + OBLIQUE @ ((np.array(SHAPE) - 1) / 2)
    points = middle + np.random.default_rng(0).uniform(-2, 2, (50, 3))
    value, slope = source.gradient(points)
    assert np.allclose(value, -20 - values_at(points), atol=0.3)
    step = 1e-5
    for axis in range(3):
        ahead, behind = (points + sign * step * np.eye(3)[axis] for sign in (1, -1))
        numeric = (source.value(ahead) - source.value(behind)) / (2 * step)
        assert np.allclose(slope[:, axis], numeric, atol=1e-5)
    # Torch's is the same, beyond the samples too, and the box holds all of them.
    at = torch.tensor(np.concatenate([points, points + 30.0]), requires_grad=True)
    level = source.level(at)
    (expected,) = torch.autograd.grad(level.sum(), at)
    value, slope = source.gradient(at.detach().numpy())
    assert np.allclose(level.detach().numpy(), value, rtol=1e-12)
    assert np.allclose(expected.numpy(), slope, rtol=1e-9, atol=1e-9)
    corners = places(grid_file.read(path)).reshape(-1, 3)
    # A sample was put around the grid, since the inside reaches its border: turned, not along x.
    assert (corners.min(axis=0) > field.box[0]).all()
    assert (corners.max(axis=0) < field.box[1]).all()
    assert np.allclose(field.box.mean(axis=0), middle)


@pytest.mark.parametrize("write", [mha, nrrd, nhdr, nii], ids=lambda write: write.__name__)
def test_labels_and_levels_of_a_turned_volume(write: Writer, tmp_path: Path) -> None:
    steps = random_rotation(5) * [0.08, 0.1, 0.12]
    shape = (40, 32, 30)
    centre = ORIGIN + steps @ ((np.array(shape) - 1) / 2)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    radius = np.linalg.norm(ORIGIN + index @ steps.T - centre, axis=-1)
    dense = write(tmp_path / "dense", 3000 - 2000 * radius, steps)
    source = FieldSource("dense", path=dense, above=1000.0)
    assert source.warnings() == []
    at = source.surface_samples(1000, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(at - centre, axis=1), 1.0, atol=2e-3)
    (tmp_path / "l").mkdir()
    label = write(tmp_path / "l" / "label", (radius < 1).astype(float), steps)
    source = FieldSource("label", path=label)
    assert "the samples are labels" in source.warnings()[0]
    at = source.surface_samples(1000, np.random.default_rng(0))
    assert np.abs(np.linalg.norm(at - centre, axis=1) - 1.0).mean() < 0.02


def test_nifti_scales_its_samples_and_may_be_without_a_place(tmp_path: Path) -> None:
    values = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)
    image = nibabel.Nifti1Image(values, np.diag([1, 2, 3, 1.0]))
    image.header.set_slope_inter(0.5, -1024)
    nibabel.save(image, tmp_path / "a.nii")
    assert np.allclose(grid_file.read(tmp_path / "a.nii").values, 0.5 * values - 1024)
    image = nibabel.Nifti1Image(values, None)
    image.header.set_zooms((1, 2, 3))
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    nibabel.save(image, tmp_path / "b.nii")
    found = grid_file.read(tmp_path / "b.nii")
    # nibabel itself would mirror x.
    assert np.array_equal(found.values, values)
    assert np.allclose(found.spacing, [1, 2, 3])
    assert not found.origin.any()
    assert "does not say how its samples lie" in found.notes[0]
    assert load(tmp_path / "b.nii", 500.0).notes[0] == found.notes[0]
    for name, data, said in (
        ("c.nii", np.zeros((8, 8, 8, 2), np.float32), r"volumes of shape \(8, 8, 8, 2\)"),
        ("d.nii", np.zeros((8, 8, 8), [("R", "u1"), ("G", "u1"), ("B", "u1")]), "not numbers"),
        ("e.nii", np.zeros((8, 8), np.float32), r"its samples have shape \(8, 8\)"),
    ):
        nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), tmp_path / name)
        with pytest.raises(InputError, match=said):
            grid_file.read(tmp_path / name)


MHA = "NDims = 3\nDimSize = 4 4 4\nElementType = MET_UCHAR\n"
NRRD = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 4 4 4\n"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.mha", MHA, "no ElementDataFile"),
        ("a.mha", MHA + "ElementDataFile = LOCAL\nabc", "3 of 64 bytes of data are there"),
        ("a.mhd", MHA + "ElementDataFile = gone.raw\n", "in gone.raw, which does not exist"),
        ("a.mhd", MHA + "ElementDataFile = .\n", "in ., which does not exist"),
        ("a.mhd", MHA + "ElementDataFile = LIST 3D\n", "LIST 3D, which is not read"),
        ("a.mhd", MHA + "ElementDataFile = s%d.raw 1 999999999 1\n", "in too many files"),
        ("a.mhd", MHA + "ElementDataFile = s%s%d.raw 1 4 1\n", "names no files by number"),
        ("a.mhd", MHA + "ElementDataFile = LIST\n", "LIST has no names of files"),
        ("a.mha", MHA.replace("3", "2", 1) + "ElementDataFile = LOCAL\n", "three dimensions"),
        ("a.mha", MHA.replace("UCHAR", "STRING") + "ElementDataFile = LOCAL\n", "MET_STRING"),
        ("a.mha", MHA.replace("4 4", "9999 9999") + "ElementDataFile = LOCAL\n", "more than"),
        ("a.mha", MHA + "ElementSpacing = 1 0 1\nElementDataFile = LOCAL\n" + 64 * "a",
         "spacing is zero"),
        ("a.mha", MHA + "ElementSpacing = 1 1\nElementDataFile = LOCAL\n" + 64 * "a",
         "1 1 are not 3 numbers"),
        ("a.mha", MHA + "TransformMatrix = 1 0 0 1 0 0 0 0 1\nElementDataFile = LOCAL\n" + 64 * "a",
         "axes lie in one plane"),
        ("a.nhdr", NRRD + "encoding: raw\n", "names no file"),
        ("a.nrrd", NRRD.replace("4 4 4", "4 nan 4") + "encoding: raw\n\n", "not a readable NRRD"),
        ("a.nhdr", NRRD + "encoding: raw\ndata file: gone.raw\n", "gone.raw, which does not exist"),
        ("a.nhdr", NRRD + "encoding: gzip\nbyte skip: -1\ndata file: a.nhdr\n", "-1 bytes"),
        ("a.nii", "no volume", "not a readable NII"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_bad_volumes(name: str, content: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=said) as error:
        identify(str(path)).open().bounding_box()
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_change_of_detached_data_is_a_change_of_the_input(tmp_path: Path, cli: Cli) -> None:
    steps = np.diag([1.0, 1, 1])
    radius = np.linalg.norm(np.indices(SHAPE) - 5.0, axis=0)
    mhd(tmp_path / "ball", radius - 3.5, steps)
    done = cli("run", "ball.mhd", "-n", 8, "--until", "evaluate", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "ball.vorolight" / "evaluate-sphere-train.json").read_text())
    assert found["metrics"]["volume"] == pytest.approx(4 / 3 * np.pi * 3.5**3, rel=0.06)
    assert "changed" not in cli("status", "ball.mhd", cwd=tmp_path).stdout
    mhd(tmp_path / "ball", radius - 3.0, steps)
    assert "ball.mhd changed" in cli("status", "ball.mhd", cwd=tmp_path).stdout
