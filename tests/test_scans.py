"""Scans: PTX, LAS, LAZ and E57, their places in space, and what they leave out."""

from __future__ import annotations

import importlib.util
import struct
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from conftest import Cli, fibonacci, random_rotation

from vorolight.stages import child
from vorolight.stages.errors import BackendMissing, InputError
from vorolight.stages.formats import cloud_file, scan_child
from vorolight.stages.formats import e57 as e57_module
from vorolight.stages.formats import las as las_module
from vorolight.stages.inputs.points.source import PointSource
from vorolight.stages.inputs.resolve import identify, kind_of

FAR = np.array([4_512_345.0, 5_401_234.0, 312.0])
"""A place as surveys have it: single precision would be off by a quarter there."""
POINTS = fibonacci(3000) * [1.5, 2.0, 2.5]


def ptx(path: Path, scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]], tail: str = "") -> Path:
    """Of points on a grid of 100 columns, each scan with its rotation and place."""
    lines: list[str] = []
    for points, turn, place in scans:
        lines += ["100", str(len(points) // 100), "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
        # Points are rows that the matrix is multiplied by.
        lines += [" ".join(map(repr, row)) + " 0" for row in turn.T.tolist()]
        lines += [" ".join(map(repr, place.tolist())) + " 1"]
        lines += [" ".join(map(repr, point)) + " 0.5 10 20 30" for point in points.tolist()]
    path.write_text("\n".join(lines) + "\n" + tail)
    return path


def las(path: Path, points: np.ndarray, noise: int = 0, withheld: int = 0) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = FAR, np.full(3, 1e-4)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    classes = np.full(len(points), 2, np.uint8)
    classes[:noise] = 7
    classes[: noise // 2] = 18
    cloud.classification = classes
    out = np.zeros(len(points), bool)
    out[noise : noise + withheld] = True
    cloud.withheld = out
    cloud.write(path)
    return path


def e57(path: Path, points: np.ndarray, turn: float, place: np.ndarray, invalid: int = 0) -> Path:
    """In two scans, of the scanner's own coordinates; it is turned about the upward axis."""
    scan = pye57.E57(str(path), mode="w")
    for part in (points[: len(points) // 2], points[len(points) // 2 :]):
        found = {f"cartesian{axis}": part[:, k].copy() for k, axis in enumerate("XYZ")}
        if invalid:
            found["cartesianInvalidState"] = np.where(np.arange(len(part)) < invalid, 2, 0)
        half = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
        scan.write_scan_raw(found, rotation=half, translation=place)
    scan.close()
    return path


def test_transforms_and_empty_directions_of_a_ptx(tmp_path: Path) -> None:
    turns = [random_rotation(1), random_rotation(2)]
    halves = [POINTS[:1500], POINTS[1500:]]
    own = [(half - [7, 8, 9]) @ turn for half, turn in zip(halves, turns, strict=True)]
    own = [np.concatenate([points, np.zeros((100, 3))]) for points in own]
    place = np.array([7.0, 8, 9])
    path = ptx(tmp_path / "a.ptx", [(own[k], turns[k], place + FAR) for k in range(2)], "\n\n")
    assert kind_of(path) == "points"
    found = cloud_file.load(path)
    assert found.points.shape == POINTS.shape
    # To rounding of numbers of five million in double precision.
    assert np.abs(found.points - FAR - POINTS).max() < 1e-8
    assert found.note == "2 scans; 200 directions without an echo are left out"
    assert PointSource(path).cloud.normals is None


PTX = "2\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("\n", "holds no scan"),
        ("hello\nworld\n", "line 1 has no whole number: hello"),
        ("1.5\n2\n", "line 1 has no whole number: 1.5"),
        (PTX + "1 2 3 0\n", r"2 x 1 points in line 1 ends early: 1 of 2 are there"),
        (PTX + "1 2 3 0\n1 2 x\n", "line 12 has no 3 numbers: 1 2 x"),
        (PTX.replace("2\n1\n", "-2\n1\n") + "1 2 3 0\n", "line 1 begins no scan"),
        (PTX.replace("1 0 0 0", "1 0 0") + "1 2 3\n" * 2, "line 7 has no 4 numbers: 1 0 0"),
        (PTX + "1 2 3 0\n" * 2 + "0\n0\n", "line 19 has no 4 numbers: the end of the file"),
        (PTX + "1 2 3 0\n" * 2, "1 different points"),
    ],
)
def test_bad_ptx(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ptx"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as error:
        cloud_file.load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_and_laz(ending: str, tmp_path: Path) -> None:
    path = las(tmp_path / f"a.{ending}", POINTS + FAR, noise=8, withheld=5)
    assert kind_of(path) == "points"
    found = cloud_file.load(path)
    assert np.abs(found.points - FAR - POINTS[13:]).max() < 0.6e-4
    assert found.note == "13 points are left out: withheld, or classified as noise"
    assert cloud_file.load(las(path, POINTS + FAR)).note == ""
    raw = path.read_bytes()
    for size in (3, 100, 300, len(raw) // 2):
        path.write_bytes(raw[:size])
        with pytest.raises(InputError, match="not a readable point cloud"):
            cloud_file.load(path)


def test_poses_and_invalid_points_of_an_e57(tmp_path: Path) -> None:
    path = e57(tmp_path / "a.e57", POINTS, 0.7, FAR, invalid=20)
    assert kind_of(path) == "points"
    found = cloud_file.load(path)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    kept = np.concatenate([POINTS[20:1500], POINTS[1520:]])
    assert np.abs(found.points - FAR - kept @ turn.T).max() < 1e-6
    assert found.note == "40 points are left out: they are marked as invalid"
    raw = path.read_bytes()
    for content in (raw[: len(raw) // 2], b"no scan", bytes(2000)):
        path.write_bytes(content)
        with pytest.raises(InputError, match="not a readable point cloud") as error:
            cloud_file.load(path)
        assert "WindowsError" not in str(error.value)
        assert path.read_bytes() == content


def test_too_many_points_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [las(tmp_path / "a.laz", POINTS + FAR), e57(tmp_path / "a.e57", POINTS, 0, FAR)]
    for module, path in zip((las_module, e57_module), paths, strict=True):
        monkeypatch.setattr(module, "LARGEST", 3 * 2999)
        with pytest.raises(ValueError, match="3000 points are more than 2999; thin them"):
            module.points(path)
    raw = bytearray(paths[0].read_bytes())
    raw[247:255] = struct.pack("<Q", 40_000_000)
    paths[0].write_bytes(raw)
    with pytest.raises(InputError, match="its header promises 40000000 points"):
        cloud_file.load(paths[0])
    raw[100:104] = struct.pack("<I", 50_000_000)
    paths[0].write_bytes(raw)
    with pytest.raises(InputError, match="its header promises 50000000 records"):
        cloud_file.load(paths[0])
    raw[100:104], raw[243:247] = struct.pack("<I", 1), struct.pack("<I", 50_000_000)
    paths[0].write_bytes(raw)
    with pytest.raises(InputError, match="its header promises 50000001 records"):
        cloud_file.load(paths[0])


def test_a_library_that_ends_its_process_or_takes_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = las(tmp_path / "a.laz", POINTS + FAR)
    run = subprocess.run

    def ended(command: list[str], **options: object) -> object:
        return run([sys.executable, "-c", "import os; os.abort()"], **options)  # type: ignore[call-overload]

    with monkeypatch.context() as patch:
        patch.setattr(child.subprocess, "run", ended)
        with pytest.raises(InputError, match=r"it ended with -6 \(read by laspy and lazrs\)"):
            cloud_file.load(path)
    monkeypatch.setattr(scan_child, "SECONDS", 0.01)
    with pytest.raises(InputError, match=r"took longer than 0.01 s"):
        cloud_file.load(path)


@pytest.mark.parametrize(
    ("name", "library"), [("a.las", "laspy"), ("a.laz", "lazrs"), ("a.e57", "pye57")]
)
def test_without_its_library_a_scan_gets_one_sentence(
    name: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(b"anything")
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda what: None if what == library else there(what)
    )
    said = (
        rf"{name}: .* read by {library}, which is not installed: pip install 'vorolight\[scans\]'"
    )
    with pytest.raises(BackendMissing, match=said):
        identify(str(tmp_path / name)).open().bounding_box()


def test_places_far_from_the_origin_cost_no_precision(tmp_path: Path, cli: Cli) -> None:
    """The surface of a scan is the same at survey coordinates as about the origin."""
    import trimesh

    surfaces = []
    for name, shift in (("near", np.zeros(3)), ("far", FAR)):
        ptx(tmp_path / f"{name}.ptx", [(POINTS, np.eye(3), shift)])
        done = cli("init", f"{name}.ptx", "-n", 8, "--iterations", 5, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        mesh = trimesh.load(tmp_path / f"{name}.vorolight" / "init.ply", process=False)
        surfaces.append(np.asarray(mesh.vertices, dtype=np.float64) - shift)
    assert surfaces[0].shape == surfaces[1].shape
    # The last digits of the coordinates decide a little of what is fitted to them.
    apart = np.abs(surfaces[0] - surfaces[1])
    assert apart.max() < 1e-3
    assert np.median(apart) < 1e-6
