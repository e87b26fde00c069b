"""Calibrated sets of pictures on disk: which files, which cameras.

nerfstudio, instant-ngp and Blender (transforms.json), COLMAP (text and binary), NDS, IDR and
Middlebury. Pictures are not opened here.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...mesh.polygons import Floats
from ...render.cameras import Camera, rigid
from . import colmap

SPACES = ("world", "opencv", "opengl")
"""Axes in which normal maps may be: the object's, or the camera's with y down and z forward, or
with y up and z back."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif")
TRANSFORMS = ("transforms.json", "transforms_train.json")
LENSES = ("k1", "k2", "k3", "k4", "p1", "p2")
SLIGHT = 1e-9
"""Distortion that is none."""


@dataclass(frozen=True)
class Shot:
    """One view. A camera of width 0 has the size of the picture."""

    name: str
    camera: Camera
    image: Path
    mask: Path | None = None
    """None: the alpha channel of the picture."""
    normal: Path | None = None
    angle: float | None = None
    """Of view, across the picture, in radians, where the focal length is to follow from it."""


@dataclass(frozen=True)
class ViewSet:
    """What a data set describes."""

    path: Path
    shots: tuple[Shot, ...]
    files: tuple[Path, ...]
    """Those with the cameras."""
    normal_space: str = "world"
    layout: str = field(default="nerfstudio")

    def all_files(self) -> list[Path]:
        """Every file that the set consists of."""
        pictures = [
            path for shot in self.shots for path in (shot.image, shot.mask, shot.normal) if path
        ]
        return list(dict.fromkeys([*self.files, *pictures]))


def is_view_set(path: Path) -> bool:
    """Whether ``path`` is a transforms.json, or a folder that a set of views is in."""
    if path.is_dir():
        return _layout(path) is not None
    return path.suffix.lower() == ".json"


def name_of(path: Path) -> str:
    """What a set is called: as its folder is, when it is a transforms.json."""
    place = path.resolve()
    return place.parent.name if place.name in TRANSFORMS else place.stem


def read(path: Path) -> ViewSet:
    """The set at ``path``. Raises InputError for files that are missing or damaged, for lenses and
    cameras that are not admitted, and for fewer than two views."""
    try:
        found = _read(path)
    except OSError as error:
        raise InputError(f"{error.filename or path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, EOFError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable set of views ({reason[:120]})") from error
    if len(found.shots) < 2:
        raise InputError(f"{path}: has {len(found.shots)} views, but a shape needs at least two")
    for shot in found.shots:
        if not rigid(shot.camera.rotation) or not np.isfinite(shot.camera.translation).all():
            raise InputError(
                f"{path}: the camera of {shot.name} is not a rigid motion (its axes are not "
                "perpendicular, of length 1 and right-handed); export the cameras again"
            )
        if not np.isfinite(shot.camera.matrix).all() or shot.camera.matrix[0, 0] <= 0:
            raise InputError(f"{path}: the camera of {shot.name} has no focal length")
    return found


def _layout(folder: Path) -> str | None:
    if any((folder / name).is_file() for name in TRANSFORMS):
        return "nerfstudio"
    if (folder / "cameras.npz").is_file():
        return "idr"
    if colmap.model_folder(folder) is not None:
        return "colmap"
    if any(folder.glob("*_par.txt")):
        return "middlebury"
    if any(folder.glob("*_k.txt")) or any((folder / "views").glob("*_k.txt")):
        return "nds"
    return None


def _read(path: Path) -> ViewSet:
    if path.is_file():
        return _transforms(path, path)
    layout = _layout(path)
    if layout is None:
        raise InputError(
            f"{path}: no cameras found in this folder; give transforms.json, or a folder of "
            "COLMAP, NDS, IDR or Middlebury"
        )
    if layout == "nerfstudio":
        return _transforms(path, next(path / n for n in TRANSFORMS if (path / n).is_file()))
    shots, files = {"idr": _idr, "colmap": _colmap, "middlebury": _middlebury, "nds": _nds}[layout](
        path
    )
    return ViewSet(path, tuple(shots), tuple(files), "world", layout)


def _picture(folder: Path, name: str) -> Path:
    """The picture called ``name``, whose ending may be left out, as Blender's sets do."""
    path = folder / name
    if path.suffix.lower() in PICTURES or path.is_file():
        return path
    found = next((p for p in (Path(f"{path}{end}") for end in PICTURES) if p.is_file()), None)
    return found or Path(f"{path}.png")


def companion(image: Path) -> Path | None:
    """A mask that lies beside a picture, or in a folder of masks beside its folder."""
    places = [image.with_name(f"{image.stem}_mask.png")]
    for name in ("mask", "masks"):
        folder = image.parent.parent / name
        places += [folder / f"{image.stem}.png", folder / f"{image.name}.png", folder / image.name]
    return next((place for place in places if place.is_file() and place != image), None)


def _transforms(path: Path, file: Path) -> ViewSet:
    """Camera-to-world matrices in OpenGL's axes."""
    content = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f"{file}: has no list of frames; it is not a transforms.json")
    space = str(content.get("normal_space", "world")).lower()
    if space not in SPACES:
        raise InputError(f"{file}: normal_space {space}: must be one of {', '.join(SPACES)}")
    shots = []
    for frame in content["frames"]:
        said = {**content, **frame}
        lens = [name for name in LENSES if abs(float(said.get(name, 0))) > SLIGHT]
        if lens:
            raise InputError(
                f"{file}: {frame['file_path']} was taken through a lens that distorts "
                f"({', '.join(lens)}); undistort the pictures first"
            )
        model = str(said.get("camera_model", "OPENCV")).upper()
        if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "ORTHOGRAPHIC"):
            raise InputError(
                f"{file}: camera model {model} is not known; make it PINHOLE or ORTHOGRAPHIC"
            )
        outer = np.array(said["transform_matrix"], dtype=np.float64)
        if outer.shape not in ((4, 4), (3, 4)):
            raise ValueError("a transform_matrix is not 4 x 4")
        rotation = (outer[:3, :3] * [1.0, -1.0, -1.0]).T
        width, height = int(said.get("w", 0)), int(said.get("h", 0))
        angle = said.get("camera_angle_x") if "fl_x" not in said else None
        focal = float(said.get("fl_x", 1.0))
        matrix = np.array(
            [
                [focal, 0.0, float(said.get("cx", 0.5 * width))],
                [0.0, float(said.get("fl_y", focal)), float(said.get("cy", 0.5 * height))],
                [0.0, 0.0, 1.0],
            ]
        )
        if angle is None and "fl_x" not in said:
            raise InputError(f"{file}: {frame['file_path']} has neither fl_x nor camera_angle_x")
        image = _picture(file.parent, str(frame["file_path"]))
        mask, normal = (frame.get(key) for key in ("mask_path", "normal_file_path"))
        shots.append(
            Shot(
                image.name,
                Camera(
                    width, height, matrix, rotation, -rotation @ outer[:3, 3],
                    model == "ORTHOGRAPHIC",
                ),
                image,
                _picture(file.parent, str(mask)) if mask else companion(image),
                _picture(file.parent, str(normal)) if normal else None,
                None if angle is None else float(angle),
            )
        )  # fmt: skip
    return ViewSet(path, tuple(shots), (file,), space)


def sized(shot: Shot, width: int, height: int) -> Camera:
    """The camera of a shot whose picture has this size. Raises InputError if it has another."""
    camera = shot.camera
    if camera.width == 0:
        matrix = camera.matrix.copy()
        for axis, size in enumerate((width, height)):
            if matrix[axis, 2] == 0:
                matrix[axis, 2] = 0.5 * size
        camera = replace(camera, width=width, height=height, matrix=matrix)
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{shot.image}: is {width} x {height} pixels, its camera is for {camera.width} x "
            f"{camera.height}; scale one of them"
        )
    if shot.angle is not None:
        focal = 0.5 * width / np.tan(0.5 * shot.angle)
        matrix = camera.matrix.copy()
        matrix[0, 0] = matrix[1, 1] = focal
        camera = replace(camera, matrix=matrix)
    return camera


def _unsized(matrix: Floats, rotation: Floats, translation: Floats) -> Camera:
    return Camera(0, 0, matrix, rotation, translation.reshape(3))


def _middlebury(folder: Path) -> tuple[list[Shot], list[Path]]:
    """``name K R t`` in a line each; pixel centres are whole numbers there."""
    file = next(iter(sorted(folder.glob("*_par.txt"))))
    lines = [line.split() for line in file.read_text().splitlines() if line.strip()]
    shots = []
    for words in lines:
        if len(words) == 1:
            continue  # how many there are
        numbers = np.array([float(word) for word in words[1:22]])
        if len(numbers) != 21:
            raise ValueError(f"{words[0]} has {len(numbers)} numbers, not 21")
        matrix = numbers[:9].reshape(3, 3)
        matrix[:2, 2] += 0.5
        image = folder / words[0]
        camera = _unsized(matrix, numbers[9:18].reshape(3, 3), numbers[18:])
        shots.append(Shot(image.name, camera, image, companion(image)))
    return shots, [file]


def _nds(folder: Path) -> tuple[list[Shot], list[Path]]:
    """``X_k.txt``, ``X_r.txt``, ``X_t.txt`` beside the picture ``X``."""
    place = folder if any(folder.glob("*_k.txt")) else folder / "views"
    shots, files = [], []
    for file in sorted(place.glob("*_k.txt")):
        stem = file.name[: -len("_k.txt")]
        parts = [place / f"{stem}_{part}.txt" for part in "krt"]
        inner, rotation, translation = (np.loadtxt(part) for part in parts)
        image = _picture(place, stem)
        camera = _unsized(inner.reshape(3, 3), rotation.reshape(3, 3), translation)
        shots.append(Shot(image.name, camera, image, companion(image)))
        files += parts
    return shots, files


def _idr(folder: Path) -> tuple[list[Shot], list[Path]]:
    """``world_mat_i @ scale_mat_i`` is a projection; pixel centres are whole numbers there."""
    file = folder / "cameras.npz"
    arrays = dict(np.load(file))
    images = sorted(p for p in (folder / "image").iterdir() if p.suffix.lower() in PICTURES)
    masks = sorted(p for p in (folder / "mask").iterdir() if p.suffix.lower() in PICTURES)
    if len(images) != len(masks):
        raise InputError(
            f"{folder}: has {len(images)} pictures and {len(masks)} masks; give one mask "
            "for each picture"
        )
    shots = []
    for number, (image, mask) in enumerate(zip(images, masks, strict=True)):
        if f"world_mat_{number}" not in arrays:
            raise InputError(f"{file}: has no camera for {image.name} (world_mat_{number})")
        whole = arrays[f"world_mat_{number}"] @ arrays.get(f"scale_mat_{number}", np.eye(4))
        matrix, rotation, translation = decomposed(np.asarray(whole[:3, :4], dtype=np.float64))
        matrix[:2, 2] += 0.5
        shots.append(Shot(image.name, _unsized(matrix, rotation, translation), image, mask))
    return shots, [file]


def decomposed(projection: Floats) -> tuple[Floats, Floats, Floats]:
    """``K``, ``R``, ``t`` of a projection ``(3, 4)``, ``K`` with a positive diagonal and 1 at its
    end."""
    from scipy.linalg import rq

    inner, rotation = rq(projection[:, :3])
    signs = np.sign(np.diag(inner))
    signs[signs == 0] = 1.0
    inner, rotation = inner * signs, signs[:, None] * rotation
    translation = np.linalg.solve(inner, projection[:, 3])
    if np.linalg.det(rotation) < 0:  # a projection has no sign of its own
        rotation, translation = -rotation, -translation
    return inner / inner[2, 2], rotation, translation


def _colmap(folder: Path) -> tuple[list[Shot], list[Path]]:
    place: Any = colmap.model_folder(folder)
    cameras, images, files = colmap.read(place)
    shots = []
    for image in sorted(images, key=lambda each: each.name):
        width, height, matrix = cameras[image.camera]
        path = next(
            (p for p in (folder / "images" / image.name, folder / image.name) if p.is_file()),
            folder / "images" / image.name,
        )
        camera = Camera(width, height, matrix, image.rotation, image.translation)
        shots.append(Shot(image.name, camera, path, companion(path)))
    return shots, files
