"""Six views of one object, as generators make them of a single picture, to a set of views.

They are orthographic, from the front, the four sides, above and below, as Hunyuan3D-2 draws them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifacts import atomic
from ..errors import BackendMissing, InputError, UsageError
from ..render import image_file
from ..render.cameras import Camera, looking
from .code import imported
from .view_pictures import decoded
from .view_writer import write_transforms

NAMES = ("front", "right", "back", "left", "top", "bottom")
AZIMUTHS, ELEVATIONS = (0, 90, 180, 270, 0, 180), (0, 0, 0, 0, 90, -90)
"""In degrees: of a camera about the object, whose y axis is up and whose front is to +z."""
WIDTH, DISTANCE = 1.2, 1.45
"""What a picture shows, and from where it is taken, in units in which the object is 1.15 large."""


@dataclass(frozen=True)
class SixViews:
    """In the order of NAMES: ``colours (6, H, W, 3)`` and ``masks (6, H, W)``, from 0 to 255, and
    ``normals (6, H, W, 3)``, unit vectors or zero in the object's axes, or None."""

    colours: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    normals: NDArray[np.float64] | None


def of_folder(folder: Path) -> SixViews:
    """``front.png``, ``right.png``, ``back.png``, ``left.png``, ``top.png``, ``bottom.png``, with
    alpha or ``NAME_mask.png``, and maybe ``NAME_normal.png``, whose red, green and blue are x, -z
    and y of the normal as in Hunyuan3D-2.

    Raises InputError for pictures that are missing, damaged or of different sizes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give one with {NAMES[0]}.png and so on")
    colours: list[Any] = []
    masks: list[Any] = []
    normals: list[Any] = []
    for name in NAMES:
        image = image_file.read(folder / f"{name}.png")
        mask, map_ = folder / f"{name}_mask.png", folder / f"{name}_normal.png"
        normal = _decoded(map_) if map_.is_file() else None
        if image.ndim == 3 and image.shape[2] == 4:
            covered = image[..., 3]
        elif mask.is_file():
            covered = image_file.read(mask)
            covered = covered if covered.ndim == 2 else covered[..., 0]
        elif normal is not None:
            covered = np.where(normal.any(axis=2), 255, 0).astype(np.uint8)
        else:
            raise InputError(
                f"{folder / name}.png: has no alpha channel, {mask.name} or {map_.name} to tell "
                "the object from the background"
            )
        image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
        colours.append(image)
        masks.append(covered)
        normals.append(normal)
    have = [normal for normal in normals if normal is not None]
    if have and len(have) < len(NAMES):
        raise InputError(f"{folder}: has {len(have)} normal maps; give six or none")
    shapes = {part.shape[:2] for part in [*colours, *masks, *have]}
    if len(shapes) > 1:
        sizes = ", ".join(sorted(f"{width} x {height}" for height, width in shapes))
        raise InputError(f"{folder}: has pictures of {sizes} pixels; scale them to one size")
    return SixViews(np.stack(colours), np.stack(masks), np.stack(have) if have else None)


def of_generator(text: str, photo: Path, allowed: bool) -> SixViews:
    """What the function ``module:function`` makes of a picture: a folder as ``of_folder`` reads.

    Raises UsageError unless code is ``allowed``, InputError for a picture that cannot be read and
    for whatever the function raises, BackendMissing for what it cannot import.
    """
    image_file.read(photo)
    function = imported(text, allowed, "--generator")
    try:
        made: Any = function(photo)
    except ImportError as error:
        raise BackendMissing(
            f"--generator {text}: needs {error.name}, which is not installed"
        ) from error
    # The user's code may raise anything.
    except Exception as error:
        raise InputError(
            f"--generator {text}: fails on {photo} ({type(error).__name__}: {str(error)[:100]})"
        ) from error
    return of_folder(Path(made))


def cameras(size: tuple[int, int]) -> list[Camera]:
    """Of the six views, for pictures of ``size`` (width, height)."""
    width, height = size
    focal = width / WIDTH
    matrix = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    found = []
    for azimuth, elevation in zip(np.radians(AZIMUTHS), np.radians(ELEVATIONS), strict=True):
        level = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
        vertical = np.array([0.0, 1.0, 0.0])
        side = np.cos(elevation) * level + np.sin(elevation) * vertical
        up = np.cos(elevation) * vertical - np.sin(elevation) * level
        camera = looking(DISTANCE * side, np.zeros(3), up, matrix, width, True)
        found.append(Camera(width, height, matrix, camera.rotation, camera.translation, True))
    return found


def write(views: SixViews, folder: Path, force: bool) -> Path:
    """The set of views in ``folder``; its transforms.json.

    Raises UsageError where there is one already and not ``force``.
    """
    target = folder / "transforms.json"
    if target.exists() and not force:
        raise UsageError(f"{target}: a set of views exists there; replace it with --force")
    target.unlink(missing_ok=True)
    frames = []
    for name in ("images", "normals"):
        if name == "images" or views.normals is not None:
            atomic.make_folder(folder / name)
    for number, name in enumerate(NAMES):
        rgba = np.concatenate([views.colours[number], views.masks[number][..., None]], axis=2)
        atomic.write(folder / "images" / f"{name}.png", image_file.png(rgba / 255))
        frames.append({"file_path": f"images/{name}.png"})
        if views.normals is not None:
            coded = 0.5 * views.normals[number] + 0.5
            atomic.write(folder / "normals" / f"{name}.png", image_file.png(coded))
            frames[-1]["normal_file_path"] = f"normals/{name}.png"
    height, width = views.masks.shape[1:]
    write_transforms(target, cameras((width, height)), frames)
    return target


def _decoded(path: Path) -> NDArray[np.float64]:
    """Unit normals in the object's axes, zero where there is none."""
    coded = decoded(path).astype(np.float64)
    return np.stack([coded[..., 0], coded[..., 2], -coded[..., 1]], axis=2)
