"""Files packed by gzip."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, fibonacci, sphere_mesh
from input_files import seeds

from vorolight.stages.errors import InputError
from vorolight.stages.formats import cloud_file, grid_file, mesh_file, packed
from vorolight.stages.formats.arrays_file import names
from vorolight.stages.inputs.resolve import identify, kind_of, up_axis


def pack(path: Path) -> Path:
    found = path.with_name(path.name + ".gz")
    found.write_bytes(gzip.compress(path.read_bytes()))
    return found


def arrays(path: Path, kind: str) -> list[np.ndarray]:
    """What a file holds."""
    if kind == "mesh":
        mesh = mesh_file.load(path).polygons
        return [mesh.vertices, mesh.face_offsets, mesh.face_vertices]
    if kind == "points":
        cloud = cloud_file.load(path)
        return [cloud.points, np.zeros(0) if cloud.normals is None else cloud.normals]
    grid = grid_file.read(path)
    return [grid.values, grid.origin, grid.spacing, grid.axes]


def test_every_format_reads_the_same_packed(tmp_path: Path) -> None:
    made = [path for path in seeds(tmp_path) if path.suffix != ".gz"]
    assert len(made) > 20
    for path in made:
        kind = kind_of(path)
        found = pack(path)
        assert kind_of(found) == kind, found
        assert identify(str(found)).stem == path.stem
        assert identify(str(found)).open().name == path.stem
        assert up_axis(str(found)) == up_axis(str(path))
        for one, other in zip(arrays(path, kind), arrays(found, kind), strict=True):
            assert one.dtype == other.dtype, found
            assert np.array_equal(one, other), found
    assert names(tmp_path / "points.npz.gz") == ["points", "normals"]


def test_what_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packed, "MOST", 100_000)
    for name in ("ball.stl", "ball.ply", "points.csv", "grid.npy", "grid.npz", "ct.nii", "a.las"):
        path = tmp_path / f"{name}.gz"
        path.write_bytes(gzip.compress(b"x" * 100_001))
        with pytest.raises(
            InputError, match=r"holds more than 0.0 GB when it is unpacked"
        ) as error:
            identify(str(path)).open().bounding_box()
        assert str(path) in str(error.value)
    (tmp_path / "a.xyz").write_text("\n".join(" ".join(map(str, x)) for x in fibonacci(300)))
    assert len(cloud_file.load(pack(tmp_path / "a.xyz")).points) == 300


def test_a_limit_is_there() -> None:
    # What a machine of 3 GB of memory can hold, and no less than the largest grid that is read.
    assert 8 * 512**3 < packed.MOST < 2e9


@pytest.mark.parametrize("name", ["cut", "turned", "sum", "plain"])
def test_damaged_gzip_files_are_named(name: str, tmp_path: Path) -> None:
    for path in (path for path in seeds(tmp_path) if path.suffix != ".gz"):
        raw = path.read_bytes()
        whole = bytearray(gzip.compress(raw))
        if name == "cut":
            whole = whole[: len(whole) // 2]
        elif name == "turned":
            whole[len(whole) // 2] ^= 0xFF
        elif name == "sum":
            whole[-8:-4] = struct.pack("<I", 1)
        else:
            whole = bytearray(raw)
        found = path.with_name(path.name + ".gz")
        found.write_bytes(whole)
        with pytest.raises(InputError, match="is damaged or no gzip file") as error:
            identify(str(found)).open().bounding_box()
        assert str(found) in str(error.value)
        assert "\n" not in str(error.value)


def test_a_name_that_does_not_say_what_is_packed(tmp_path: Path) -> None:
    path = tmp_path / "ball.gz"
    path.write_bytes(gzip.compress(b"anything"))
    with pytest.raises(InputError, match="its name does not say what is packed in it"):
        identify(str(path)).open().bounding_box()
    path = tmp_path / "ball.tar.gz"
    path.write_bytes(gzip.compress(b"anything"))
    with pytest.raises(InputError, match="is compressed; unpack it"):
        identify(str(path)).open().bounding_box()


def test_a_run_of_a_packed_mesh(tmp_path: Path, cli: Cli) -> None:
    import trimesh

    trimesh.Trimesh(*sphere_mesh(), process=False).export(tmp_path / "ball.obj")
    before = pack(tmp_path / "ball.obj").read_bytes()
    (tmp_path / "ball.obj").unlink()
    done = cli("init", "ball.obj.gz", "-n", 6, "--iterations", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "ball.vorolight" / "classify.json").read_text())
    assert record["inputs"][0]["name"] == "ball"
    assert (tmp_path / "ball.obj.gz").read_bytes() == before
    done = cli("evaluate", "ball.obj.gz", "--of", "init", "--surface", "ball.obj.gz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ball.vorolight" / "evaluate-file-ball.json").is_file()
    (tmp_path / "shapes.txt").write_text("ball.obj.gz\n")
    done = cli("sbatch", "shapes.txt", cwd=tmp_path)
    assert "ball.vorolight" in done.stdout + done.stderr
