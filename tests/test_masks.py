"""Masks of views as files: their range, and which side of them is the object."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import torus_mesh, write_ply
from PIL import Image
from scipy.ndimage import binary_fill_holes

from vorolight.stages.errors import InputError
from vorolight.stages.inputs.views import files as view_files
from vorolight.stages.inputs.views import pictures as view_pictures
from vorolight.stages.inputs.views.silhouettes import Reading
from vorolight.stages.inputs.views.source import ViewSource
from vorolight.stages.inputs.views.writer import write_views


@pytest.fixture
def views(tmp_path: Path) -> Path:
    """Four views of a torus."""
    mesh = write_ply(tmp_path / "torus.ply", *torus_mesh(1.0, 0.4, 48, 24))
    write_views(mesh, tmp_path / "views", 4, 64, None, 1, False, 2)
    return tmp_path / "views"


def with_masks(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Put mask files ``change(covered)`` beside the pictures, which lose their alpha; the coverage
    of the pictures before."""
    before = []
    for file in sorted((folder / "images").glob("[0-9][0-9][0-9].png")):
        covered = np.asarray(Image.open(file))[..., 3] >= 128
        before.append(covered)
        Image.open(file).convert("RGB").save(file)
        Image.fromarray(change(covered)).save(file.with_name(f"{file.stem}_mask.png"))
    return np.array(before)


@pytest.mark.parametrize(
    "change",
    [
        lambda covered: covered.astype(np.uint8),
        lambda covered: 3 * covered.astype(np.uint8),
        lambda covered: 255 * covered.astype(np.uint16),
        lambda covered: covered.astype(np.uint16),
        lambda covered: 65535 * covered.astype(np.uint16),
    ],
)
def test_masks_are_read_by_their_range(
    change: Callable[[np.ndarray], np.ndarray], views: Path
) -> None:
    expected = with_masks(views, change)
    found = view_pictures.load(view_files.read(views))
    assert np.array_equal(found.masks >= 128, expected)


def test_inverted_masks_are_named(views: Path) -> None:
    with_masks(views, lambda covered: np.where(covered, 0, 255).astype(np.uint8))
    with pytest.raises(InputError, match="they seem inverted"):
        view_pictures.load(view_files.read(views))


@pytest.mark.parametrize("change", [lambda c: 255 * c, lambda c: c, lambda c: 65535 * c])
def test_masks_may_be_inverted_by_an_option(
    change: Callable[[np.ndarray], np.ndarray], views: Path
) -> None:
    expected = with_masks(views, lambda covered: change((~covered).astype(np.uint16)))
    found = view_pictures.load(view_files.read(views), 1, Reading(inverted=True))
    assert np.array_equal(found.masks >= 128, expected)


def test_masks_of_any_colour_are_read(views: Path) -> None:
    expected = with_masks(
        views, lambda covered: covered[..., None].astype(np.uint8) * np.array([0, 0, 120], np.uint8)
    )
    found = view_pictures.load(view_files.read(views))
    assert np.array_equal(found.masks >= 128, expected)


def flattened(folder: Path, colour: int) -> np.ndarray:
    """Put the pictures on a background of this grey, as Blender's sets are without alpha; their
    coverage before."""
    before = []
    for file in sorted((folder / "images").glob("*.png")):
        rgba = np.asarray(Image.open(file)).astype(np.float64)
        alpha = rgba[..., 3:] / 255
        before.append(alpha[..., 0] >= 0.5)
        flat = 0.6 * rgba[..., :3] * alpha + colour * (1 - alpha)
        Image.fromarray(np.rint(flat).astype(np.uint8)).save(file)
    transforms = json.loads((folder / "transforms.json").read_text())
    for frame in transforms["frames"]:
        del frame["normal_file_path"]
    (folder / "transforms.json").write_text(json.dumps(transforms))
    return np.array(before)


@pytest.mark.parametrize("colour", [255, 0])
def test_opaque_pictures_are_keyed_and_what_they_enclose_is_said(colour: int, views: Path) -> None:
    expected = flattened(views, colour)
    source = ViewSource(views)
    whole = np.stack([binary_fill_holes(mask) for mask in expected])
    assert overlap(source.views.masks >= 128, whole) > 0.95
    keyed, enclosed = source.views.notes
    assert "4 of 4 pictures are opaque and have no masks" in keyed
    assert "if they are openings, use --enclosed background" in enclosed
    source = ViewSource(views)
    source.reading = Reading((colour,) * 3, openings=True)
    assert overlap(source.views.masks >= 128, expected) > 0.95
    assert len(source.views.notes) == 1


def overlap(found: np.ndarray, expected: np.ndarray) -> float:
    return float((found & expected).sum() / (found | expected).sum())
