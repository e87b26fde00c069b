"""Cameras and sets of views: geometry, every layout on disk, pictures that do not agree."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import (
    CAMERA_MATRIX,
    camera,
    edit,
    sphere_mesh,
    torus_mesh,
    write_ply,
)
from PIL import Image
from scipy.spatial.transform import Rotation

from vorolight.stages.errors import InputError, UsageError
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.inputs.views import files as view_files
from vorolight.stages.inputs.views import pictures as view_pictures
from vorolight.stages.inputs.views.source import ViewSource
from vorolight.stages.inputs.views.writer import write_views
from vorolight.stages.render import image_file
from vorolight.stages.render.cameras import Camera, rigid


@pytest.fixture(scope="module")
def torus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of a torus with normals; the folder."""
    folder = tmp_path_factory.mktemp("torus")
    mesh = write_ply(folder / "torus.ply", *torus_mesh(1.0, 0.4, 48, 24))
    write_views(mesh, folder / "views", 8, 96, None, 1, False, 2)
    return folder / "views"


@pytest.fixture
def copied(torus: Path, tmp_path: Path) -> Path:
    """A copy of the views to be spoiled."""
    import shutil

    return Path(shutil.copytree(torus, tmp_path / "views"))


def test_written_views_read_back(torus: Path) -> None:
    found = view_files.read(torus)
    assert (found.layout, found.normal_space, len(found.shots)) == ("nerfstudio", "world", 8)
    views = view_pictures.load(found, 2)
    assert views.masks.shape == (8, 96, 96)
    assert views.normals is not None
    size = np.linalg.norm(views.normals / 32767, axis=3)[views.masks == 255]
    np.testing.assert_allclose(size, 1, atol=1e-3)
    for here in views.cameras:  # all of it is in the picture, nearly filling it
        pixel = here.project(torus_mesh(1.0, 0.4, 48, 24)[0])[:, :2]
        assert pixel.min() > 0
        assert pixel.max() < 96


def on_disk(folder: Path, layout: str, cameras: list[Camera], names: list[str]) -> None:
    """The cameras as ``layout`` writes them; pictures lie where it has them."""
    if layout == "middlebury":
        lines = [str(len(cameras))]
        for name, here in zip(names, cameras, strict=True):
            inner = here.matrix.copy()
            inner[:2, 2] -= 0.5
            numbers = [*inner.reshape(-1), *here.rotation.reshape(-1), *here.translation]
            lines.append(" ".join([name, *map(repr, map(float, numbers))]))
        (folder / "some_par.txt").write_text("\n".join(lines) + "\n")
    elif layout == "nds":
        for name, here in zip(names, cameras, strict=True):
            for part, values in zip("krt", (here.matrix, here.rotation, here.translation),
                                    strict=True):  # fmt: skip
                np.savetxt(folder / f"{Path(name).stem}_{part}.txt", values)
    elif layout == "idr":
        arrays = {}
        scale = np.diag([2.0, 2.0, 2.0, 1.0])
        scale[:3, 3] = [0.3, -0.2, 0.1]
        for number, here in enumerate(cameras):
            inner = here.matrix.copy()
            inner[:2, 2] -= 0.5
            world = np.eye(4)
            world[:3] = -3.0 * inner @ np.column_stack([here.rotation, here.translation])
            arrays[f"world_mat_{number}"] = world @ np.linalg.inv(scale)
            arrays[f"scale_mat_{number}"] = scale
        np.savez(folder / "cameras.npz", **arrays)
    else:
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        quaternions = [
            Rotation.from_matrix(here.rotation).as_quat(scalar_first=True) for here in cameras
        ]
        inner = [here.matrix for here in cameras]
        values = [(k[0, 0], k[1, 1], k[0, 2], k[1, 2]) for k in inner]
        if layout == "colmap text":
            (model / "cameras.txt").write_text(
                "# cameras\n"
                + "".join(
                    f"{i + 1} PINHOLE 240 180 {' '.join(map(repr, map(float, v)))}\n"
                    for i, v in enumerate(values)
                )
            )
            (model / "images.txt").write_text(
                "# images\n"
                + "".join(
                    " ".join(map(str, [i + 1, *map(float, [*q, *c.translation]), i + 1, name]))
                    + "\n1.0 2.0 -1\n"
                    for i, (q, c, name) in enumerate(zip(quaternions, cameras, names, strict=True))
                )
            )
        else:
            data = struct.pack("<Q", len(cameras))
            for i, v in enumerate(values):
                data += struct.pack("<iiQQ4d", i + 1, 1, 240, 180, *v)
            (model / "cameras.bin").write_bytes(data)
            data = struct.pack("<Q", len(cameras))
            for i, (q, c, name) in enumerate(zip(quaternions, cameras, names, strict=True)):
                data += struct.pack("<i7di", i + 1, *q, *c.translation, i + 1)
                data += name.encode() + b"\0" + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
            (model / "images.bin").write_bytes(data)


@pytest.mark.parametrize("layout", ["middlebury", "nds", "idr", "colmap text", "colmap binary"])
def test_every_layout_gives_the_same_cameras(layout: str, tmp_path: Path) -> None:
    cameras = [camera(seed) for seed in range(3)]
    if layout.startswith("colmap"):
        straight = CAMERA_MATRIX.copy()
        straight[0, 1] = 0
        cameras = [Camera(240, 180, straight, c.rotation, c.translation, False) for c in cameras]
    names = [f"v{number}.png" for number in range(3)]
    folder = {"idr": "image", "colmap text": "images", "colmap binary": "images"}.get(layout, ".")
    masks = {"idr": "mask", "colmap text": "masks", "colmap binary": "masks"}.get(layout)
    for place in (folder, masks or "."):
        (tmp_path / place).mkdir(exist_ok=True)
    grey = np.zeros((180, 240))
    grey[60:120, 80:160] = 1
    for name in names:
        (tmp_path / folder / name).write_bytes(image_file.png(np.repeat(grey[..., None], 3, 2)))
        place = tmp_path / masks / name if masks else tmp_path / name.replace(".", "_mask.")
        place.write_bytes(image_file.png(grey))
    on_disk(tmp_path, layout, cameras, names)
    assert identify(str(tmp_path)).kind == "views"
    views = view_pictures.load(view_files.read(tmp_path))
    points = np.random.default_rng(1).normal(size=(10, 3)) * 0.2
    for given, found in zip(cameras, views.cameras, strict=True):
        assert (found.width, found.height) == (240, 180)
        np.testing.assert_allclose(
            found.project(points)[:, :2], given.project(points)[:, :2], atol=1e-6
        )
        assert rigid(found.rotation)
    assert (views.masks == 255).sum() == 3 * 60 * 80


def test_blender_sets_have_an_angle_and_names_without_an_ending(copied: Path) -> None:
    before = view_pictures.load(view_files.read(copied)).cameras

    def change(content: dict[str, Any]) -> None:
        focal, width = content["frames"][0]["fl_x"], content["frames"][0]["w"]
        content["camera_angle_x"] = 2 * np.arctan(0.5 * width / focal)
        content["frames"] = [
            {
                "file_path": f"./images/{number:03d}",
                "transform_matrix": frame["transform_matrix"],
            }
            for number, frame in enumerate(content["frames"])
        ]
        del content["camera_model"]

    edit(copied, change)
    found = view_pictures.load(view_files.read(copied))
    assert found.normals is None
    np.testing.assert_allclose(found.cameras[2].matrix, before[2].matrix, rtol=1e-9)


@pytest.mark.parametrize("space", ["world", "opencv", "opengl"])
def test_normals_in_any_axes_and_a_flipped_one_is_named(space: str, copied: Path) -> None:
    found = view_files.read(copied)
    views = view_pictures.load(found)
    assert views.normals is not None
    for axis in [None, 0, 1, 2]:
        for number, (shot, here) in enumerate(zip(found.shots, views.cameras, strict=True)):
            normal = views.normals[number] / 32767
            if space != "world":
                signs = [1, 1, 1] if space == "opencv" else [1, -1, -1]
                normal = normal @ here.rotation.T * signs
            if axis is not None:
                normal = np.where(np.arange(3) == axis, -normal, normal)
            assert shot.normal is not None
            shot.normal.write_bytes(image_file.png(0.5 * normal + 0.5))
        edit(copied, lambda content: content.update(normal_space=space))
        if axis is None:
            again = view_pictures.load(view_files.read(copied)).normals
            assert again is not None
            # Eight bits hold a normal to half a degree.
            close = (again.astype(float) * views.normals).sum(axis=3) / 32767**2
            assert close[views.masks == 255].min() > 0.999
        else:
            with pytest.raises(InputError, match=f"their {'xyz'[axis]} axis flipped"):
                view_pictures.load(view_files.read(copied))


def spoil_missing(folder: Path) -> None:
    (folder / "images" / "003.png").unlink()


def spoil_damaged(folder: Path) -> None:
    (folder / "images" / "003.png").write_bytes(b"\x89PNG\r\n\x1a\nno picture")


def spoil_size(folder: Path) -> None:
    file = folder / "images" / "003.png"
    Image.open(file).resize((48, 48)).save(file)


def spoil_sizes(folder: Path) -> None:
    spoil_size(folder)

    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            del frame["normal_file_path"]
        content["frames"][3].update(w=48, h=48)

    edit(folder, change)


def spoil_mask(folder: Path) -> None:
    mask = np.zeros((96, 96))
    mask[30:60, 30:60] = 1
    (folder / "images" / "003_mask.png").write_bytes(image_file.png(mask))
    file = folder / "images" / "003.png"
    Image.open(file).convert("RGB").resize((48, 48)).save(file)


def spoil_camera(folder: Path) -> None:
    edit(folder, lambda c: c["frames"][3]["transform_matrix"][0].__setitem__(0, 2.5))


def spoil_mirror(folder: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        for row in content["frames"][3]["transform_matrix"]:
            row[0] = -row[0]

    edit(folder, change)


def spoil_empty(folder: Path) -> None:
    (folder / "images" / "003.png").write_bytes(image_file.png(np.zeros((96, 96, 4))))


def spoil_full(folder: Path) -> None:
    (folder / "images" / "003_mask.png").write_bytes(image_file.png(np.ones((96, 96))))


def without_normals(folder: Path) -> None:
    edit(folder, lambda content: [frame.pop("normal_file_path") for frame in content["frames"]])


def spoil_alpha(folder: Path) -> None:
    without_normals(folder)
    speckled = np.random.default_rng(0).random((96, 96, 3))
    (folder / "images" / "003.png").write_bytes(image_file.png(speckled))


def spoil_blank(folder: Path) -> None:
    without_normals(folder)
    (folder / "images" / "003.png").write_bytes(image_file.png(np.ones((96, 96, 4))))


def spoil_few(folder: Path) -> None:
    edit(folder, lambda content: content.update(frames=content["frames"][:1]))


def spoil_lens(folder: Path) -> None:
    edit(folder, lambda content: content.update(k1=0.1))


def spoil_model(folder: Path) -> None:
    edit(folder, lambda content: content.update(camera_model="FISHEYE"))


def spoil_json(folder: Path) -> None:
    (folder / "transforms.json").write_text('{"frames": [')


def spoil_frames(folder: Path) -> None:
    (folder / "transforms.json").write_text('{"views": 3}')


def spoil_normal(folder: Path) -> None:
    edit(folder, lambda content: content["frames"][3].pop("normal_file_path"))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (spoil_missing, "003.png: this picture is missing"),
        (spoil_damaged, "003.png: not a readable picture"),
        (spoil_size, "003.png: is 48 x 48 pixels, its camera is for 96 x 96"),
        (spoil_sizes, "000.png is 96 x 96 pixels, 003.png is 48 x 48"),
        (spoil_mask, "003_mask.png: is 96 x 96 pixels, 003.png is not"),
        (spoil_camera, "the camera of 003.png is not a rigid motion"),
        (spoil_mirror, "the camera of 003.png is not a rigid motion"),
        (spoil_empty, "003.png: the mask is empty"),
        (spoil_full, "003_mask.png: the mask covers the whole picture"),
        (spoil_alpha, "003.png: has no alpha channel, no mask beside it, and no background of one"),
        (spoil_blank, "003.png: has no alpha channel, no mask beside it, and one colour"),
        (spoil_few, "has 1 views"),
        (spoil_lens, "distorts \\(k1\\)"),
        (spoil_model, "camera model FISHEYE"),
        (spoil_json, "not a readable set of views"),
        (spoil_frames, "has no list of frames"),
        (spoil_normal, "003.png has no normal map but others have"),
    ],
)
def test_bad_sets_are_refused_in_a_sentence(
    spoil: Callable[[Path], None], said: str, copied: Path
) -> None:
    spoil(copied)
    with pytest.raises(InputError, match=said):
        view_pictures.load(view_files.read(copied))


def test_views_that_do_not_meet_and_views_along_a_line(copied: Path, tmp_path: Path) -> None:
    def aside(content: dict[str, Any]) -> None:
        for number in (1, 4):
            content["frames"][number]["transform_matrix"][0][3] += 40.0

    edit(copied, aside)
    with pytest.raises(InputError, match=r"do not meet; the worst are 00[14].png, 00[14].png"):
        ViewSource(copied).polygons  # noqa: B018

    mesh = write_ply(tmp_path / "ball.ply", *sphere_mesh(1.0, 3))
    write_views(mesh, tmp_path / "line", 6, 64, "orthographic", 0, False, 1)
    edit(tmp_path / "line", lambda content: content.update(frames=content["frames"][0:4:3]))
    with pytest.raises(InputError, match="all views look along one line"):
        ViewSource(tmp_path / "line").polygons  # noqa: B018


def test_a_change_of_any_picture_changes_the_input(copied: Path) -> None:
    before = identify(str(copied))
    assert (before.kind, before.name) == ("views", "views")
    assert identify(str(copied / "transforms.json")).sha256 == before.sha256
    spoil_full(copied)
    assert identify(str(copied)).sha256 != before.sha256


def test_a_folder_without_cameras_is_no_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder without cameras"):
        identify(str(tmp_path))
    with pytest.raises(InputError, match="is a folder, but --kind mesh needs a file"):
        identify(str(tmp_path), "mesh")


def test_a_set_is_not_replaced_unasked(torus: Path, tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "ball.ply", *sphere_mesh(1.0, 2))
    with pytest.raises(UsageError, match="a set of views exists there"):
        write_views(mesh, torus, 2, 32, None, 0, False, 1)
