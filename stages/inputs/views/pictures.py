"""The pictures of a set of views: masks and normals, checked against each other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mesh.polygons import Floats
from ...render import image_file
from ...render.cameras import Camera
from ...render.views import COVERED, UNIT, Views
from .files import SPACES, Shot, ViewSet, sized
from .silhouettes import PLAIN, Reading, Silhouette, decoded, notes, refuse_inverted, silhouette

RIM = 1.5
"""Pixels from the outline in which a normal should point the way out."""
AGREEING, TELLING = 0.4, 0.2
"""Mean cosine, in the picture, of normals and the way out, at the outlines, below which the maps
are wrong; it is asked if normals there lie so far in the picture, on average."""
FLIPPED = 0.3
"""Share of what an axis adds to that, without regard to signs, from which on less than nothing
means that it is flipped."""


def load(found: ViewSet, threads: int = 1, reading: Reading = PLAIN) -> Views:
    """Cameras, masks and normals of all views.

    Raises InputError for pictures that are missing, damaged or of different sizes, for masks that
    are not there, empty or full, and for normals that contradict the masks.
    """
    with ThreadPoolExecutor(threads) as pool:
        loaded = list(pool.map(lambda shot: _load(found, shot, reading), found.shots))
    cameras, shown, normals = zip(*loaded, strict=True)
    first = found.shots[0]
    for shot, camera in zip(found.shots, cameras, strict=True):
        if (camera.width, camera.height) != (cameras[0].width, cameras[0].height):
            raise InputError(
                f"{found.path}: {first.name} is {cameras[0].width} x {cameras[0].height} pixels, "
                f"{shot.name} is {camera.width} x {camera.height}; scale them to one size"
            )
    have = [normal is not None for normal in normals]
    if any(have) and not all(have):
        raise InputError(
            f"{found.path}: {found.shots[have.index(False)].name} has no normal map but others "
            "have; give all of them or none"
        )
    views = Views(
        tuple(cameras),
        np.stack([each.mask for each in shown]),
        np.stack(normals) if all(have) else None,
        tuple(notes(shown, [shot.name for shot in found.shots])),
    )
    refuse_inverted(found.path, views.masks)
    if all(have):
        check_normals(found, views)
    return views


def colours(shot: Shot) -> NDArray[np.float32]:
    """The picture of a view ``(H, W, 3)``, from 0 to 1. Raises InputError."""
    image = image_file.read(shot.image)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return image[..., :3].astype(np.float32) / np.float32(255)


def _load(
    found: ViewSet, shot: Shot, reading: Reading
) -> tuple[Camera, Silhouette, NDArray[np.int16] | None]:
    shown = silhouette(shot.image, shot.mask, shot.normal, reading)
    mask = shown.mask
    height, width = mask.shape
    camera = sized(shot, width, height)
    normal = None
    if shot.normal is not None:
        normal = _normals(found, shot, camera)
        if normal.shape[:2] != mask.shape:
            raise InputError(
                f"{shot.normal}: is {normal.shape[1]} x {normal.shape[0]} pixels, the mask of "
                f"{shot.name} {width} x {height}; scale one of them"
            )
        normal[mask < COVERED] = 0
    return camera, shown, normal


def _normals(found: ViewSet, shot: Shot, camera: Camera) -> NDArray[np.int16]:
    """In the object's axes, in units of 1 / UNIT."""
    assert shot.normal is not None
    normal = decoded(shot.normal) @ _axes(found.normal_space, camera).astype(np.float32)
    return np.asarray(np.rint(UNIT * normal), dtype=np.int16)


def _axes(space: str, camera: Camera) -> Floats:
    """Rows: the axes of normals in ``space``, in the object's."""
    if space == "world":
        return np.eye(3)
    signs = np.array([1.0, 1.0, 1.0]) if space == "opencv" else np.array([1.0, -1.0, -1.0])
    return np.asarray(signs[:, None] * camera.rotation)


def check_normals(found: ViewSet, views: Views) -> None:
    """Raise InputError, naming the axis to flip, unless normals point out of the outlines of the
    masks and towards the cameras."""
    space = found.normal_space
    along, size = np.zeros(3), np.zeros(3)
    sideways = toward = total = 0.0
    for number, camera in enumerate(views.cameras):
        row, column, way = _rim(views.masks[number])
        axes = _axes(space, camera)
        normals: Any = views.normals
        normal = normals[number][row, column] / UNIT
        outward = way @ camera.rotation[:2]
        sideways += float(np.linalg.norm(normal @ camera.rotation[:2].T, axis=1).sum())
        total += len(normal)
        product = (normal @ axes.T) * (outward @ axes.T)
        along += product.sum(axis=0)
        size += np.abs(product).sum(axis=0)
        inner = normals[number][::4, ::4].reshape(-1, 3)
        centres = camera.pixel_centres().reshape(camera.height, camera.width, 2)
        rays = camera.rays(centres[::4, ::4].reshape(-1, 2))
        toward -= float((inner * rays).sum()) / UNIT
    wrong = [
        name
        for name, value, most in zip("xyz", along, size, strict=True)
        if value < -FLIPPED * most and most > 0.01 * total
    ]
    if not wrong and toward < 0:
        # No outline shows the depth of camera axes, and turned right round all of them are wrong.
        wrong = ["z"]
    if wrong:
        raise InputError(
            f"{found.path}: the normal maps have their {' and '.join(wrong)} axis flipped (taken "
            f"as {space} axes): flip it, or set normal_space to another of {', '.join(SPACES)}"
        )
    # Of a box that stands square to the cameras, the pixels at the outlines say nothing.
    if sideways > TELLING * total and along.sum() < AGREEING * sideways:
        raise InputError(
            f"{found.path}: the normal maps do not fit the masks when taken as {space} "
            "axes (at the outlines, the mean cosine between normals and the outward "
            f"direction is {along.sum() / sideways:.2f}); set normal_space"
        )


def _rim(mask: NDArray[np.uint8]) -> tuple[Any, Any, Floats]:
    """Rows and columns of the pixels within the outline, and the way out there ``(N, 2)``: right
    and down. Where the object leaves the picture there is no outline."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    inside = mask >= COVERED
    near = distance_transform_edt(np.pad(inside, 1, mode="edge"))[1:-1, 1:-1]
    rows, columns = np.nonzero(inside & (near <= RIM))
    smooth = gaussian_filter(inside.astype(np.float64), 2.0, mode="nearest")
    down, right = np.gradient(smooth)
    way = -np.column_stack([right[rows, columns], down[rows, columns]])
    size = np.linalg.norm(way, axis=1)
    good = size > 1e-3
    return rows[good], columns[good], way[good] / size[good, None]
