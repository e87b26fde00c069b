"""Sparse models of COLMAP, as text and as binary files: cameras and poses."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...mesh.polygons import Floats

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""Number -> name and count of parameters."""
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
STRAIGHT = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""Models that are admitted, if what they have beyond focal lengths and centre is zero."""

Inner = tuple[int, int, Floats]
"""Width, height and matrix."""


@dataclass(frozen=True)
class Pose:
    """From the world's axes to those of the camera that took picture ``name``."""

    name: str
    camera: int
    rotation: Floats
    translation: Floats


def model_folder(folder: Path) -> Path | None:
    """Where under ``folder`` a model lies."""
    for place in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any(
            (place / f"cameras.{end}").is_file() and (place / f"images.{end}").is_file()
            for end in ("bin", "txt")
        ):
            return place
    return None


def read(folder: Path) -> tuple[dict[int, Inner], list[Pose], list[Path]]:
    """Cameras by number, poses, and the two files. Raises InputError for lenses that distort, and
    ValueError or struct.error's kin for damaged files."""
    if (folder / "cameras.bin").is_file():
        files = [folder / "cameras.bin", folder / "images.bin"]
        try:
            return _binary_cameras(files[0]), _binary_images(files[1]), files
        except struct.error as error:
            raise ValueError(f"a file ends too early: {error}") from error
    files = [folder / "cameras.txt", folder / "images.txt"]
    return _text_cameras(files[0]), _text_images(files[1]), files


def _inner(file: Path, model: str, width: int, height: int, values: list[float]) -> Inner:
    focals = 1 if model in ONE_FOCAL else 2
    if model not in STRAIGHT or any(values[focals + 2 :]):
        raise InputError(
            f"{file}: a camera of model {model} distorts; undistort the pictures first (colmap "
            "image_undistorter)"
        )
    fx, fy, (cx, cy) = values[0], values[focals - 1], values[focals : focals + 2]
    return width, height, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _rotation(quaternion: list[float]) -> Floats:
    from scipy.spatial.transform import Rotation

    w, x, y, z = quaternion
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def _lines(file: Path) -> list[list[str]]:
    lines = file.read_text(encoding="utf-8").splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def _text_cameras(file: Path) -> dict[int, Inner]:
    return {
        int(words[0]): _inner(
            file, words[1], int(words[2]), int(words[3]), [float(word) for word in words[4:]]
        )
        for words in _lines(file)
        if words
    }


def _text_images(file: Path) -> list[Pose]:
    lines = _lines(file)
    while lines and not lines[-1]:
        lines.pop()
    poses = []
    for words in lines[::2]:  # every second line, which may be empty, lists points
        numbers = [float(word) for word in words[1:8]]
        name = " ".join(words[9:])
        poses.append(Pose(name, int(words[8]), _rotation(numbers[:4]), np.array(numbers[4:])))
    return poses


def _binary_cameras(file: Path) -> dict[int, Inner]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, cameras = 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name, length = MODELS.get(model, (f"number {model}", 0))
        values = list(struct.unpack_from(f"<{length}d", data, at + 24))
        cameras[number] = _inner(file, name, width, height, values)
        at += 24 + 8 * length
    return cameras


def _binary_images(file: Path) -> list[Pose]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, poses = 8, []
    for _ in range(count):
        _, *numbers, camera = struct.unpack_from("<i7di", data, at)
        at += 64
        end = data.index(b"\0", at)
        name = data[at:end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        poses.append(Pose(name, camera, _rotation(numbers[:4]), np.array(numbers[4:])))
    return poses
