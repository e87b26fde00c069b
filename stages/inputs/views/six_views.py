"""Six views of one object, as generators make them of a single picture, to a set of views.

They are orthographic, from the front, the four sides, above and below, as Hunyuan3D-2 draws them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...artifacts import atomic
from ...errors import BackendMissing, InputError, UsageError
from ...render import image_file
from ...render.cameras import Camera, looking
from ...render.views import COVERED
from ..field.code import imported
from .files import PICTURES
from .silhouettes import (
    PLAIN,
    Reading,
    Silhouette,
    decoded,
    edge_of,
    notes,
    refuse_inverted,
    silhouette,
)
from .writer import write_transforms

NAMES = ("front", "right", "back", "left", "top", "bottom")
AZIMUTHS, ELEVATIONS = (0, 90, 180, 270, 0, 180), (0, 0, 0, 0, 90, -90)
"""In degrees: of a camera about the object, whose y axis is up and whose front is to +z."""
WIDTH, DISTANCE = 1.2, 1.45
"""What a picture shows, and from where it is taken, in units in which the object is 1.15 large."""


ALSO = {"up": "top", "above": "top", "down": "bottom", "below": "bottom"}
COMPANIONS = {"mask": "mask", "masks": "mask", "normal": "normal", "normals": "normal"}
ROOM = 2
"""Pixels that are left around an object which reaches the edge of its picture."""


@dataclass(frozen=True)
class SixViews:
    """In the order of NAMES: ``colours (6, H, W, 3)`` and ``masks (6, H, W)``, from 0 to 255, and
    ``normals (6, H, W, 3)``, unit vectors or zero in the object's axes, or None; in ``notes`` what
    was assumed of them."""

    colours: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    normals: NDArray[np.float64] | None
    notes: tuple[str, ...] = ()


def of_folder(
    folder: Path, order: Sequence[str] | None = None, reading: Reading = PLAIN
) -> SixViews:
    """Pictures with front, right, back, left, top and bottom in their names, or with six numbers,
    which are then in this ``order``, by default that of NAMES; with masks, alpha or a background as
    ``reading`` says, and maybe ``NAME_normal.png``, whose red, green and blue are x, -z and y of
    the normal as in Hunyuan3D-2. Pictures of different sizes are padded to equal squares.

    Raises InputError for pictures that are missing or damaged, or have no silhouette, and
    UsageError for an order of pictures with names.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give one with {NAMES[0]}.png and so on")
    images, companions = _pictures(folder, order)
    said = []
    if order is None and "front" not in images["front"].stem.lower():
        pairs = ", ".join(f"{images[name].name} as {name}" for name in NAMES)
        said.append(f"the pictures were taken in this order: {pairs}; --order gives another")
    colours: list[Any] = []
    shown: list[Silhouette] = []
    normals: list[Any] = []
    for name in NAMES:
        mask, map_ = (companions.get((name, what)) for what in ("mask", "normal"))
        found = silhouette(images[name], mask, map_, reading)
        image = image_file.read(images[name])
        image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
        normal = None if map_ is None else _decoded(map_)
        if normal is not None and normal.shape != image.shape:
            raise InputError(f"{map_}: has another size than {images[name].name}; scale one")
        colours.append(image)
        shown.append(found)
        normals.append(normal)
    have = [normal for normal in normals if normal is not None]
    if have and len(have) < len(NAMES):
        raise InputError(f"{folder}: has {len(have)} normal maps; give six or none")
    masks = [each.mask for each in shown]
    refuse_inverted(folder, masks)
    said += notes(shown, [images[name].name for name in NAMES])
    shapes = {mask.shape for mask in masks}
    side = max(max(shape) for shape in shapes)
    touched = [
        images[name].name
        for name, mask in zip(NAMES, masks, strict=True)
        if (mask[edge_of(*mask.shape)] >= COVERED).any()
    ]
    if touched:
        side += 2 * ROOM
        said.append(
            f"the object reaches the edge of {', '.join(touched)}: it was taken to end there"
        )
    if len(shapes) > 1 or next(iter(shapes)) != (side, side):
        sizes = ", ".join(sorted(f"{width} x {height}" for height, width in shapes))
        said.append(f"pictures of {sizes} pixels were padded to {side} x {side}")
    return SixViews(
        np.stack([_padded(colour, side) for colour in colours]),
        np.stack([_padded(mask, side) for mask in masks]),
        np.stack([_padded(normal, side) for normal in have]) if have else None,
        tuple(said),
    )


def parse_order(text: str) -> tuple[str, ...]:
    """The views that numbered pictures are, as ``--order`` names them. Raises UsageError."""
    order = tuple(ALSO.get(word, word) for word in text.lower().replace(" ", "").split(","))
    if sorted(order) != sorted(NAMES):
        raise UsageError(f"--order {text}: must be {', '.join(NAMES)} in some order, with commas")
    return order


def _pictures(
    folder: Path, order: Sequence[str] | None
) -> tuple[dict[str, Path], dict[tuple[str, str], Path]]:
    """The picture of each view, and its mask and normal map by view and ``mask`` or ``normal``."""
    named: dict[str, list[Path]] = {}
    numbered: dict[tuple[str, ...], dict[int, Path]] = {}
    beside: dict[tuple[str, str], Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in PICTURES:
            continue
        words = re.findall(r"[a-z]+|[0-9]+", path.stem.lower())
        what = next((COMPANIONS[word] for word in words if word in COMPANIONS), None)
        words = [word for word in words if word not in COMPANIONS]
        if not words:
            continue
        views = [ALSO.get(word, word) for word in words if ALSO.get(word, word) in NAMES]
        key = (views or words)[-1]
        if what is not None:
            beside[str(int(key)) if key.isdigit() else key, what] = path
        elif key in NAMES:
            named.setdefault(key, []).append(path)
        elif key.isdigit():
            group = numbered.setdefault(tuple(words[:-1]), {})
            if int(key) in group:
                raise InputError(
                    f"{folder}: {group[int(key)].name} and {path.name} have the same number; leave "
                    "one of them"
                )
            group[int(key)] = path
    if named:
        images = {}
        for name in NAMES:
            found = named.get(name, [])
            exact = [path for path in found if path.stem.lower() == name]
            if len(found) > 1 and len(exact) != 1:
                raise InputError(
                    f"{folder}: {found[0].name} and {found[1].name} may both be the view from the "
                    f"{name}; leave one of them"
                )
            if not found:
                raise InputError(
                    f"{folder / name}.png: this picture is missing; six are needed: "
                    f"{', '.join(NAMES)}"
                )
            images[name] = (exact or found)[0]
        if order is not None:
            raise UsageError(f"--order: the pictures in {folder} have names; leave it out")
        return images, beside
    six = [numbers for numbers in numbered.values() if len(numbers) == len(NAMES)]
    if len(six) != 1:
        counts = " and ".join(str(len(numbers)) for numbers in numbered.values()) or "no"
        raise InputError(
            f"{folder}: has {counts} numbered pictures; six are needed, such as {NAMES[0]}.png to "
            f"{NAMES[-1]}.png, or image0.png to image5.png"
        )
    place = dict(zip(order or NAMES, sorted(six[0]), strict=True))
    named_after = {str(number): name for name, number in place.items()}
    return {name: six[0][place[name]] for name in NAMES}, {
        (named_after[key], what): path for (key, what), path in beside.items() if key in named_after
    }


def _padded(image: NDArray[Any], side: int) -> NDArray[Any]:
    """With zeros around, ``(side, side, ...)``."""
    height, width = image.shape[:2]
    top, left = (side - height) // 2, (side - width) // 2
    padded = np.zeros((side, side, *image.shape[2:]), image.dtype)
    padded[top : top + height, left : left + width] = image
    return padded


def of_generator(
    text: str,
    photo: Path,
    allowed: bool,
    order: Sequence[str] | None = None,
    reading: Reading = PLAIN,
) -> SixViews:
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
    return of_folder(Path(made), order, reading)


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
