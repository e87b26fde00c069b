"""Which pixels of a picture are the object: by a mask, alpha, a normal map, or the background's
colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, UsageError
from ...render import image_file
from ...render.views import COVERED

FEWEST = 16
"""Pixels of a mask that are an object, and of what is around it."""
INVERTED = 0.9
"""Share of the pixels at the pictures' edges that masks cover, above which they are inverted."""
COLOURS = {"white": (255, 255, 255), "black": (0, 0, 0)}
NEAR, NEAR_LOSSY = 12, 32
"""Of 255, by which a channel of the background may differ from its colour: around an object, lossy
compression leaves more."""
LOSSY = (".jpg", ".jpeg", ".webp", ".heic", ".heif")
UNIFORM = 0.75
"""Share of the pixels at a picture's edge that must have one colour for it to be the background's,
where none is given."""
SPECK = 5e-4
"""Share of a picture below which an area that is keyed apart from the rest is noise."""
LENGTHS = (0.7, 1.3)
"""Between them a pixel of a normal map holds a normal."""

Mask = NDArray[np.uint8]


@dataclass(frozen=True)
class Reading:
    """How pictures are to be read."""

    background: tuple[int, int, int] | None = None
    """Of opaque pictures without masks. None: what most of a picture's edge has."""
    openings: bool = False
    """Whether areas of the background's colour that the object encloses are background."""
    inverted: bool = False
    """Whether masks and alpha have the object dark."""


PLAIN = Reading()


@dataclass(frozen=True)
class Silhouette:
    """``mask (H, W)``, from 0 to 255."""

    mask: Mask
    place: Path
    """The file that it was taken from."""
    background: tuple[int, int, int] | None = None
    """The colour that was taken out, if the picture is opaque."""
    enclosed: float = 0.0
    """Share of the picture that has this colour within the object."""


def parse_background(text: str) -> tuple[int, int, int] | None:
    """The colour that ``--background`` names; None for auto. Raises UsageError."""
    word = text.strip().lower()
    if word == "auto":
        return None
    if word in COLOURS:
        return COLOURS[word]
    parts = word.split(",")
    if len(parts) != 3 or not all(part.strip().isdigit() and int(part) < 256 for part in parts):
        raise UsageError(
            f"--background {text}: must be auto, white, black, or red, green and blue from 0 to "
            "255, as in 0,177,64"
        )
    red, green, blue = map(int, parts)
    return red, green, blue


def silhouette(image: Path, mask: Path | None, normal: Path | None, reading: Reading) -> Silhouette:
    """Of the picture ``image``: its ``mask``, or else its alpha, or where its ``normal`` map has
    none, or else all but its background.

    Raises InputError for pictures that are missing or damaged, and where there is no silhouette.
    """
    found = _silhouette(image, mask, normal, reading)
    covered = int((found.mask >= COVERED).sum())
    if covered < FEWEST and found.background is not None:
        raise InputError(
            f"{image}: has no alpha channel, no mask beside it, and one colour throughout; add "
            f"{image.stem}_mask.png, or remove its view"
        )
    if covered < FEWEST:
        raise InputError(f"{found.place}: the mask is empty; draw it, or remove its view")
    if covered > found.mask.size - FEWEST:
        raise InputError(
            f"{found.place}: the mask covers the whole picture; give one that leaves the "
            "background out"
        )
    return found


def _silhouette(
    image: Path, mask: Path | None, normal: Path | None, reading: Reading
) -> Silhouette:
    if mask is not None:
        covered = of_file(mask)
        height, width = covered.shape
        if image_file.size(image) != (width, height):
            raise InputError(
                f"{mask}: is {width} x {height} pixels, {image.name} is not; scale one"
            )
        return Silhouette(255 - covered if reading.inverted else covered, mask)
    picture = image_file.read(image)
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() < 255:
        alpha = picture[..., 3]
        return Silhouette(np.ascontiguousarray(255 - alpha if reading.inverted else alpha), image)
    if reading.inverted:
        raise InputError(f"{image}: has neither a mask nor alpha; --invert-masks has no effect")
    if normal is not None:
        told = decoded(normal).any(axis=2)
        if FEWEST <= told.sum() <= told.size - FEWEST and told.shape == picture.shape[:2]:
            return Silhouette(np.where(told, 255, 0).astype(np.uint8), normal)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    return _keyed(image, picture[..., :3].astype(np.int16), reading)


def of_file(path: Path) -> Mask:
    """The mask drawn in the file ``path``, ``(H, W)`` from 0 to 255, by the range of its values.
    Raises InputError."""
    image = image_file.read(path, by_range=True)
    mask: Mask = image
    if image.ndim == 3:
        alone = image.shape[2] == 4 and image[..., 3].min() < 255
        mask = image[..., 3] if alone else image[..., :3].max(axis=2)
    top = int(mask.max(initial=0))
    if 0 < top < COVERED:  # of labels, such as 0 and 1
        mask = np.asarray(255 * mask.astype(np.int64) // top, dtype=np.uint8)
    return np.ascontiguousarray(mask)


def decoded(path: Path) -> NDArray[np.float32]:
    """The unit vectors ``(H, W, 3)`` of a normal map, zero where it has none. Raises InputError."""
    image = image_file.read(path)
    if image.ndim != 3:
        raise InputError(f"{path}: a normal map has three channels, this has one")
    normal = image[..., :3].astype(np.float32) * np.float32(2 / 255) - 1
    length = np.sqrt(np.einsum("hwk,hwk->hw", normal, normal))
    good = (length > LENGTHS[0]) & (length < LENGTHS[1])
    if image.shape[2] == 4:
        good &= image[..., 3] >= COVERED
    return np.asarray(
        np.where(good[..., None], normal / np.maximum(length, 0.1)[..., None], 0), np.float32
    )


def edge_of(height: int, width: int) -> NDArray[np.bool_]:
    """The outermost pixels ``(H, W)`` of a picture."""
    edge = np.ones((height, width), dtype=bool)
    edge[1:-1, 1:-1] = False
    return edge


def _keyed(image: Path, colours: NDArray[np.int16], reading: Reading) -> Silhouette:
    """Without what of the background's colour is connected to the edge of the picture."""
    from scipy.ndimage import label, maximum_filter

    edge = edge_of(*colours.shape[:2])
    most = np.median(colours[edge], axis=0).astype(np.int16)
    ground = np.array(most if reading.background is None else reading.background, np.int16)
    off = np.abs(colours - ground).max(axis=2)
    near = NEAR_LOSSY if image.suffix.lower() in LOSSY else NEAR
    share = float((off[edge] <= near).mean())
    if reading.background is None and share < UNIFORM:
        raise InputError(
            f"{image}: has no alpha channel, no mask beside it, and no background of one colour; "
            f"add {image.stem}_mask.png, or say --background R,G,B"
        )
    if share == 0:
        raise InputError(
            f"{image}: has no background of the colour {_named(ground)} at its edge, which is "
            f"mostly {_named(most)}; say --background {_named(most)}"
        )
    flat, count = label(off <= near)
    sizes = np.bincount(flat.ravel(), minlength=count + 1)
    outer = np.zeros(count + 1, dtype=bool)
    outer[np.unique(flat[edge])] = True
    within = ~outer & (sizes > SPECK * off.size)
    outer[0] = within[0] = False
    if reading.openings:
        outer |= within
    away = outer[flat]
    # At the outline a pixel has both colours: its share of the object's is that of the difference
    # which the pixels beside it have.
    most_off = maximum_filter(off, 3).astype(np.float64)
    mask = np.rint(255 * np.minimum(1, off / np.maximum(most_off, 1)))
    beside = maximum_filter(away, 3)
    mask[~beside], mask[away] = 255, 0
    # What compression leaves around the object.
    parts, count = label(mask >= COVERED)
    small = np.bincount(parts.ravel(), minlength=count + 1) < SPECK * off.size
    small[0] = False
    mask[small[parts]] = 0
    enclosed = 0.0 if reading.openings else float(sizes[within].sum() / off.size)
    red, green, blue = map(int, ground)
    return Silhouette(mask.astype(np.uint8), image, (red, green, blue), enclosed)


def _named(colour: Any) -> str:
    values = tuple(map(int, colour))
    return next(
        (name for name, known in COLOURS.items() if known == values), ",".join(map(str, values))
    )


def refuse_inverted(place: Path, masks: Sequence[Mask] | Mask) -> None:
    """Raise InputError where ``masks`` cover the edges of the pictures and leave out the rest."""
    covered = [mask[edge_of(*mask.shape)] >= COVERED for mask in masks]
    if np.concatenate(covered).mean() > INVERTED:
        raise InputError(
            f"{place}: the masks cover the edges of the pictures and leave out what is within, so "
            "they seem inverted; use --invert-masks"
        )


def notes(found: Sequence[Silhouette], names: Sequence[str]) -> list[str]:
    """What was assumed of opaque pictures, in sentences."""
    said = []
    keyed = [each for each in found if each.background is not None]
    if keyed:
        colours = sorted({_named(each.background) for each in keyed})
        said.append(
            f"{len(keyed)} of {len(found)} pictures are opaque and have no masks: what is "
            f"connected to their edges in their background's colour ({'; '.join(colours[:3])}) "
            "was taken as the background"
        )
    shares = [each.enclosed for each in found]
    if any(shares):
        worst = int(np.argmax(shares))
        said.append(
            f"{np.count_nonzero(shares)} of {len(found)} pictures have areas of the background's "
            f"colour within the object (most, {shares[worst]:.1%} of the picture, in "
            f"{names[worst]}): they were taken as parts of it; if they are openings, use "
            "--enclosed background"
        )
    return said
