"""Files of point clouds."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import fibonacci

from vorolight.stages.errors import InputError
from vorolight.stages.sources import cloud_file
from vorolight.stages.sources.points import PointSource
from vorolight.stages.sources.resolve import identify, kind_of


def write_expe(path: Path, points: np.ndarray, normals: np.ndarray) -> None:
    head = "[Expe/PointSet/Binary/0.1]\nproperty position 12\nproperty radius 4\nproperty normal 12"
    body = b"".join(
        struct.pack("<3ff3f", *point, 1.0, *normal)
        for point, normal in zip(points, normals, strict=True)
    )
    path.write_bytes(f"{head}\nnofpoints {len(points)}\ndata\n".encode() + body)


def test_every_format_reads_the_same(tmp_path: Path) -> None:
    points = fibonacci(200, 2.0).astype(np.float32).astype(np.float64)
    normals = points / 2
    table = np.concatenate([points, normals], axis=1)
    np.savetxt(tmp_path / "a.xyz", table)
    np.savetxt(tmp_path / "b.csv", table, delimiter=",", header="x,y,z,nx,ny,nz", comments="")
    np.savetxt(tmp_path / "c.pts", table, header="200", comments="")
    np.savetxt(tmp_path / "d.asc", table, delimiter=" ; ", header="# made by hand")
    np.save(tmp_path / "e.npy", table)
    np.savez(tmp_path / "f.npz", points=points, normals=normals)
    write_expe(tmp_path / "g.pts", points, normals)
    header = "ply\nformat {} 1.0\nelement vertex 200\n" + "".join(
        f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    header += "end_header\n"
    for name, kind, body in (
        ("h", "binary_little_endian", table.astype("<f8").tobytes()),
        ("i", "binary_big_endian", table.astype(">f8").tobytes()),
        ("j", "ascii", "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode()),
    ):
        (tmp_path / f"{name}.ply").write_bytes(header.format(kind).encode() + body)
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == 10
    for path in paths:
        assert kind_of(path) == "points", path.name
        found = cloud_file.load(path)
        assert np.allclose(found.points, points, atol=1e-6), path.name
        assert found.normals is not None, path.name
        assert np.allclose(found.normals, normals, atol=1e-6), path.name


def test_colours_are_no_normals(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).integers(0, 255, (200, 3))
    np.savetxt(tmp_path / "a.xyz", np.concatenate([fibonacci(200), colours], axis=1))
    np.savetxt(
        tmp_path / "b.pts", np.concatenate([fibonacci(200), colours[:, :1], colours], axis=1)
    )
    for name in ("a.xyz", "b.pts"):
        found = cloud_file.load(tmp_path / name)
        assert found.normals is None
        assert np.allclose(found.points, fibonacci(200))


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    points = np.concatenate([fibonacci(2000), fibonacci(2000)[:7], np.full((3, 3), np.nan)])
    np.save(tmp_path / "a.npy", points)
    source = PointSource(tmp_path / "a.npy")
    assert (source.cloud.doubled, source.cloud.not_finite) == (7, 3)
    assert np.array_equal(source.cloud.points, fibonacci(2000))
    assert any(
        "3 points have coordinates that are not finite" in said for said in source.warnings()
    )
    assert source.describe()["points"] == 2000


def test_large_clouds_are_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud_file, "MOST", 500)
    np.save(tmp_path / "a.npy", fibonacci(800))
    found = cloud_file.load(tmp_path / "a.npy")
    assert (len(found.points), found.thinned) == (500, 300)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"", "empty"),
        ("a.xyz", b"hello\nworld\n", "no row of three numbers"),
        ("a.xyz", b"0 0 0\n1 0 0\n0 1 0\n", "3 different points"),
        ("a.xyz", b"1 2 3\n" * 500, "1 different points"),
        ("a.xyz", b"0 0 0\n1 0 0 0 0\n" * 100, "not a readable point cloud"),
        ("a.csv", b"1,2\n" * 300, "no row of three numbers"),
        ("a.pts", b"\x00\x01\x02" * 300, "no text"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n", "0 different points"),
    ],
)  # fmt: skip
def test_bad_clouds(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        identify(str(path)).open()
    assert str(path) in str(error.value)


def test_flat_clouds_are_refused(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((500, 2)) @ np.array([[1.0, 2, 3], [3, 1, -2]])
    np.save(tmp_path / "a.npy", points + 7)
    with pytest.raises(InputError, match="one plane"):
        PointSource(tmp_path / "a.npy")
