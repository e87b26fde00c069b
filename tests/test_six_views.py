"""Six views as generators leave them: names, sizes, backgrounds, and silhouettes that disagree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, sphere_mesh
from PIL import Image

from vorolight.stages.artifacts import hdf5
from vorolight.stages.errors import InputError, UsageError
from vorolight.stages.inputs.resolve import recorded_up
from vorolight.stages.inputs.views import (
    alignment as view_alignment,
)
from vorolight.stages.inputs.views import (
    files as view_files,
)
from vorolight.stages.inputs.views import (
    pictures as view_pictures,
)
from vorolight.stages.inputs.views import (
    six_views,
)
from vorolight.stages.inputs.views.hull import VisualHull
from vorolight.stages.inputs.views.silhouettes import Reading
from vorolight.stages.inputs.views.six_views import NAMES, SixViews, of_folder
from vorolight.stages.inputs.views.source import ViewSource
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.render import drawing
from vorolight.stages.render.views import Views

SIZE = 96


def mesh() -> tuple[np.ndarray, np.ndarray]:
    """A body longer than it is wide, with a nose: no two of its views are alike."""
    vertices, triangles = sphere_mesh(1.0, 4)
    nose = 0.5 * np.exp(-((np.linalg.norm(vertices - [0.3, 0.5, 0.8], axis=1) / 0.5) ** 2))
    return (vertices * [0.2, 0.3, 0.4]) * (1 + nose[:, None]), triangles


def drawn(scale: np.ndarray, shift: np.ndarray) -> list[np.ndarray]:
    """The views of ``mesh`` with alpha, each scaled about its middle and shifted by pixels."""
    vertices, triangles = mesh()
    pictures = []
    for number, camera in enumerate(six_views.cameras((SIZE, SIZE))):
        matrix = camera.matrix.copy()
        matrix[:2, :2] *= scale[number]
        matrix[:2, 2] += shift[number]
        camera = replace(camera, matrix=matrix)
        rgba, _ = drawing.draw(vertices, triangles, None, camera, 2)
        pictures.append(np.rint(255 * rgba).astype(np.uint8))
    return pictures


AGREEING = drawn(np.ones(6), np.zeros((6, 2)))
SCALE = np.array([1.3, 0.8, 1.1, 0.9, 1.2, 0.7])
SHIFT = np.array([[3, -2], [-5, 4], [0, 6], [2, 2], [-4, -3], [7, 1]])
"""Right and down, in pixels."""
FRAMED = drawn(SCALE, SHIFT)


def save(folder: Path, pictures: list[np.ndarray], names: tuple[str, ...] = NAMES) -> Path:
    folder.mkdir(exist_ok=True)
    for name, picture in zip(names, pictures, strict=True):
        Image.fromarray(picture).save(folder / f"{name}.png")
    return folder


def on(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """The picture, opaque, on a background of this colour."""
    alpha = picture[..., 3:] / 255
    flat = picture[..., :3] * alpha + np.array(colour) * (1 - alpha)
    return np.rint(flat).astype(np.uint8)


def written(tmp_path: Path, pictures: list[np.ndarray]) -> Path:
    made = of_folder(save(tmp_path / "made", pictures))
    return six_views.write(made, tmp_path / "views", True)


def overlap(made: SixViews, pictures: list[np.ndarray]) -> float:
    """The least intersection over union of the masks and those that were drawn."""
    drawn_ = np.stack([picture[..., 3] >= 128 for picture in pictures])
    found = made.masks >= 128
    both, either = drawn_ & found, drawn_ | found
    return float((both.sum(axis=(1, 2)) / either.sum(axis=(1, 2))).min())


def test_views_that_agree_are_not_changed(tmp_path: Path) -> None:
    file = written(tmp_path, AGREEING)
    source = ViewSource(file)
    plain = view_pictures.load(view_files.read(file))
    for given, used in zip(plain.cameras, source.views.cameras, strict=True):
        np.testing.assert_array_equal(given.matrix, used.matrix)
    np.testing.assert_array_equal(plain.masks, source.views.masks)
    np.testing.assert_array_equal(
        plain.masks, np.stack([picture[..., 3] for picture in AGREEING])
    )  # fmt: skip
    assert source.fit is None
    assert source.views.notes == ()


def test_views_that_were_framed_by_themselves_are_fitted(tmp_path: Path) -> None:
    source = ViewSource(written(tmp_path, FRAMED))
    assert source.fit is None
    said = " ".join(source.views.notes)
    assert "the views were scaled (most, by" in said
    assert source.fit is not None
    # All but a common scale and a common shift of the object are undone.
    product = source.fit.scale * SCALE
    np.testing.assert_allclose(product / product.mean(), 1, atol=0.015)
    vertices, _ = mesh()
    seen = [camera.project(vertices)[:, :2] for camera in six_views.cameras((SIZE, SIZE))]
    unscaled = np.stack(
        [
            (SIZE / 2 + (pixels - SIZE / 2) * scale + shift - used.matrix[:2, 2])
            / used.matrix[0, 0]
            for pixels, scale, shift, used in zip(
                seen, SCALE, SHIFT, source.views.cameras, strict=True
            )
        ]
    )
    # Each view's plane holds two coordinates of one object, moved and scaled as a whole.
    planes = np.stack([camera.rotation[:2] for camera in source.views.cameras])
    system = np.concatenate(
        [
            np.concatenate([(planes @ vertices[k]).reshape(-1, 1), planes.reshape(-1, 3)], axis=1)
            for k in (0, 40, 200, 900)
        ]
    )
    target = np.concatenate([unscaled[:, k].reshape(-1) for k in (0, 40, 200, 900)])
    (scale, *_), *_ = np.linalg.lstsq(system, target, rcond=None)
    off = system @ np.linalg.lstsq(system, target, rcond=None)[0] - target
    assert np.abs(off).max() < 0.015 * np.ptp(vertices, axis=0).max() * scale


def test_a_mask_that_is_wrong_is_not_taken_for_another_scale(tmp_path: Path) -> None:
    pictures = [picture.copy() for picture in AGREEING]
    pictures[1][:, : SIZE // 2, 3] = 0  # half of the view from the right
    source = ViewSource(written(tmp_path, pictures))
    (said,) = source.views.notes
    assert "no scales and shifts of the views make them agree" in said
    assert source.fit is None


def test_where_an_object_leaves_its_picture_nothing_is_compared() -> None:
    """The views from the right and the left are shifted until a fifth of each is beyond a side."""
    shift = np.zeros((6, 2))
    shift[[1, 3]] = [50, 0]
    views = Views(
        tuple(six_views.cameras((SIZE, SIZE))),
        np.stack([picture[..., 3] for picture in drawn(np.ones(6), shift)]),
        None,
    )
    assert views.masks[1, :, -1].any()
    found, _ = view_alignment.fit(views, list(NAMES), 0, 1)
    assert found is not None
    np.testing.assert_allclose(found.scale, 1, atol=0.02)
    # A shift of the whole object would add to one what it takes from the other.
    np.testing.assert_allclose(SIZE * (found.shift[1] + found.shift[3]), [-100, 0], atol=2)


def test_a_fit_is_described_and_kept(tmp_path: Path) -> None:
    source = ViewSource(written(tmp_path, FRAMED))
    # The hull does for the surface, which takes long to fit.
    hull = VisualHull(source.views, source.names, 0, 1)
    source.__dict__["polygons"] = PolygonMesh.of_triangles(*hull.surface(hull.box(), 32))
    told = source.describe()
    assert told["up"] == "y"
    assert told["mask_overlap_worst"] > 0.94
    product = np.array([told["fit"]["scale"][f"{name}.png"] for name in NAMES]) * SCALE
    np.testing.assert_allclose(product / product.mean(), 1, atol=0.015)
    assert told["fit"]["largest_scale"] > 1.2
    assert "the silhouettes reached up to" in source.warnings()[0]
    assert not [said for said in source.warnings() if "do not fit" in said]
    # Later stages open the views with what was found.
    again = ViewSource(source.path)
    voxels = {
        "origin": np.zeros(3),
        "spacing": np.array(1.0),
        "interior": np.ones((2, 2, 2), bool),
        "exterior": np.zeros((2, 2, 2), bool),
    }
    file = tmp_path / "classify.h5"
    file.write_bytes(hdf5.encode("classify", {**voxels, **source.state()}, {"stage": "classify"}))
    again.restore(hdf5.read(file, "classify")[0])
    for given, used in zip(source.views.cameras, again.views.cameras, strict=True):
        np.testing.assert_array_equal(given.matrix, used.matrix)
    assert again.describe() == told
    assert recorded_up({"metrics": {"input": told}, "inputs": [{"path": "views"}]}) == "y"


def test_numbered_pictures_have_an_order(tmp_path: Path) -> None:
    turned = ("bottom", "front", "top", "back", "left", "right")
    for folder, names in (
        ("a", tuple(f"image{k}" for k in range(6))),
        ("b", tuple(f"{k:03d}" for k in range(6))),
        ("c", tuple(f"view_{k}" for k in range(1, 7))),
        ("d", tuple(f"rgb_000_{name}" for name in NAMES)),
        ("e", ("Front", "RIGHT", "back", "left", "up", "down")),
    ):
        made = of_folder(save(tmp_path / folder, AGREEING, names))
        assert overlap(made, AGREEING) == 1
        said = " ".join(made.notes)
        assert ("taken in this order" in said) == (folder in "abc")
    pictures = [AGREEING[NAMES.index(name)] for name in turned]
    folder = save(tmp_path / "f", pictures, tuple(f"image{k}" for k in range(6)))
    Image.fromarray(pictures[0]).save(folder / "photo.png")  # is none of them
    assert overlap(of_folder(folder, turned), AGREEING) == 1
    assert overlap(of_folder(folder), AGREEING) < 0.9
    assert six_views.parse_order("bottom, front,up,back,left,right") == turned
    for bad in ("front,back", "front,front,back,left,top,bottom"):
        with pytest.raises(UsageError, match=f"--order {bad}: must be front, right"):
            six_views.parse_order(bad)
    with pytest.raises(UsageError, match="have names; leave it out"):
        of_folder(tmp_path / "d", turned)


def test_masks_and_normals_of_numbered_pictures_go_with_them(tmp_path: Path) -> None:
    names = tuple(f"image{k}" for k in range(6))
    folder = save(tmp_path / "made", [on(p, (90, 120, 10)) for p in AGREEING], names)
    for name, picture in zip(names, AGREEING, strict=True):
        Image.fromarray(picture[..., 3]).save(folder / f"{name}_mask.png")
        Image.fromarray(np.full((SIZE, SIZE, 3), (255, 127, 127), np.uint8)).save(
            folder / f"{name}_normal.png"
        )
    made = of_folder(folder)
    assert overlap(made, AGREEING) == 1
    assert made.normals is not None
    np.testing.assert_allclose(made.normals[3, 5, 5], [1, 0, 0], atol=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda folder: (folder / "image3.png").unlink(), "has 5 numbered pictures; six are"),
        (lambda folder: save(folder, AGREEING[:1], ("image6",)), "has 7 numbered pictures"),
        (lambda folder: save(folder, AGREEING[:1], ("front",)), "right.png: this picture is"),
        (
            lambda folder: Image.fromarray(AGREEING[0][..., :3]).save(folder / "image2.jpg"),
            "image2.jpg and image2.png have the same number",
        ),
    ],
)
def test_pictures_that_are_not_six_are_refused(
    change: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    folder = save(tmp_path / "made", AGREEING, tuple(f"image{k}" for k in range(6)))
    change(folder)
    with pytest.raises(InputError, match=said):
        of_folder(folder)


def test_pictures_of_several_sizes_are_padded_not_distorted(tmp_path: Path) -> None:
    pictures = [picture.copy() for picture in AGREEING]
    for number, (rows, columns) in enumerate([(20, 0), (20, 10), (0, 10), (0, 0), (0, 24)]):
        height, width = SIZE - rows, SIZE - columns
        top, left = rows // 2, columns // 2
        pictures[number] = pictures[number][top : top + height, left : left + width]
    made = of_folder(save(tmp_path / "made", pictures))
    assert made.masks.shape == (6, SIZE, SIZE)
    assert overlap(made, AGREEING) == 1
    assert f"were padded to {SIZE} x {SIZE}" in " ".join(made.notes)


def test_pictures_cropped_to_the_object_get_room(tmp_path: Path) -> None:
    pictures = []
    for picture in AGREEING:
        rows, columns = (np.flatnonzero((picture[..., 3] > 127).any(axis=k)) for k in (1, 0))
        pictures.append(picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    made = of_folder(save(tmp_path / "made", pictures))
    assert not made.masks[:, [0, -1]].any()
    assert not made.masks[:, :, [0, -1]].any()
    assert "reaches the edge of front.png" in " ".join(made.notes)
    source = ViewSource(six_views.write(made, tmp_path / "views", True))
    assert source.views.notes == ()  # in the middle and to one scale they agree


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("colour", [(255, 255, 255), (0, 0, 0), (20, 180, 60)])
def test_an_opaque_background_is_keyed(
    colour: tuple[int, int, int], ending: str, tmp_path: Path
) -> None:
    folder = tmp_path / "made"
    folder.mkdir()
    pictures = [picture.copy() for picture in AGREEING]
    for picture in pictures:
        picture[..., :3] = [110, 60, 150]
        picture[44:52, 44:52, :3] = colour  # within the object
    for number, picture in enumerate(pictures):
        flat = Image.fromarray(on(picture, colour))
        flat.save(folder / f"image{number}.{ending}", quality=80)
    made = of_folder(folder)
    assert overlap(made, AGREEING) > 0.97
    assert (made.masks[:, 46:50, 46:50] == 255).all()
    said = " ".join(made.notes)
    assert "6 of 6 pictures are opaque and have no masks" in said
    assert "were taken as parts of it; if they are openings, use --enclosed background" in said
    made = of_folder(folder, None, Reading(colour, openings=True))
    assert (made.masks[:, 46:50, 46:50] == 0).all()
    assert "openings" not in " ".join(made.notes)
    wrong = (200, 10, 200)
    with pytest.raises(InputError, match=r"no background of the colour 200,10,200 at its edge"):
        of_folder(folder, None, Reading(wrong))


def test_the_same_pictures_are_refused_everywhere_for_the_same_reason(
    tmp_path: Path, cli: Cli
) -> None:
    file = written(tmp_path, AGREEING)
    speckled = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)
    for place in (tmp_path / "made", file.parent / "images"):
        Image.fromarray(speckled).save(place / "left.png")
    reason = "left.png: has no alpha channel, no mask beside it, and no background of one colour"
    first = cli("from-image", "made/front.png", "--six-views", "made", cwd=tmp_path)
    second = cli("classify", "views", "-n", 8, cwd=tmp_path)
    third = cli("run", "views", "-n", 8, cwd=tmp_path)
    for done in (first, second, third):
        assert done.returncode == 3
        assert reason in done.stderr
    for place in (tmp_path / "made", file.parent / "images"):
        for name, picture in zip(NAMES, AGREEING, strict=True):
            Image.fromarray(on(picture, (255, 255, 255))).save(place / f"{name}.png")
    said = "6 of 6 pictures are opaque"
    words = ["--background", "white"]
    done = cli("from-image", "made/front.png", "--six-views", "made", *words, "-o", "again",
               cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert said in done.stderr
    assert said in " ".join(ViewSource(file).views.notes)
    done = cli("classify", "views", "-n", 8, "--background", "beige", cwd=tmp_path)
    assert done.returncode == 2
    assert "--background beige: must be auto, white, black, or red" in done.stderr
    for words in (["--background", "white"], ["--invert-masks"], ["--enclosed", "background"]):
        done = cli("classify", "sphere", "-n", 8, *words, cwd=tmp_path)
        assert done.returncode == 2
        assert f"{words[0]}: needs views, but the input is of kind field" in done.stderr


def test_inverted_masks_of_six_views(tmp_path: Path) -> None:
    pictures = [picture.copy() for picture in AGREEING]
    for picture in pictures:
        picture[..., 3] = 255 - picture[..., 3]
    folder = save(tmp_path / "made", pictures)
    with pytest.raises(InputError, match="they seem inverted; use --invert-masks"):
        of_folder(folder)
    assert overlap(of_folder(folder, None, Reading(inverted=True)), AGREEING) == 1
