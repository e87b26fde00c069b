"""Pictures of phones: HEIC files, made here by pillow-heif, read by the library of the extra."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, torus_mesh, write_ply
from PIL import Image

from vorolight.stages.errors import InputError
from vorolight.stages.inputs.views import files as view_files
from vorolight.stages.inputs.views import pictures as view_pictures
from vorolight.stages.inputs.views.writer import write_views
from vorolight.stages.render import image_file


def write_heic(path: Path, picture: Image.Image) -> Path:
    """Losslessly, but for the rounding between RGB and the file's own colours."""
    import pillow_heif

    heif = pillow_heif.from_pillow(picture)
    heif.save(path, quality=-1, chroma=444)
    return path


def ramp() -> np.ndarray:
    """A picture ``(48, 64, 4)``, opaque in the middle."""
    y, x = np.mgrid[:48, :64]
    inside = (x > 9) & (x < 50) & (y > 9) & (y < 40)
    return np.stack([4 * x, 5 * y, 0 * x + 90, 255 * inside], axis=2).astype(np.uint8)


@pytest.mark.parametrize("ending", [".heic", ".HEIF"])
@pytest.mark.parametrize("channels", [3, 4])
def test_a_heic_picture_is_read_as_it_was(ending: str, channels: int, tmp_path: Path) -> None:
    drawn = ramp()[..., :channels]
    path = write_heic(tmp_path / f"photo{ending}", Image.fromarray(drawn))
    found = image_file.read(path)
    assert found.shape == drawn.shape
    assert np.abs(found.astype(int) - drawn)[..., :3].max() <= 3
    if channels == 4:
        np.testing.assert_array_equal(found[..., 3], drawn[..., 3])
    assert image_file.size(path) == (64, 48)


@pytest.mark.parametrize("kept", [0, 30, 300])
def test_a_damaged_heic_picture_is_refused(kept: int, tmp_path: Path) -> None:
    path = write_heic(tmp_path / "photo.heic", Image.fromarray(ramp()))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"photo\.heic: not a readable picture"):
        image_file.read(path)


def test_views_may_be_heic_pictures(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "torus.ply", *torus_mesh(1.0, 0.4, 32, 16))
    file = write_views(mesh, tmp_path / "views", 3, 64, None, 1, False, 2)
    before = view_pictures.load(view_files.read(file), 1).masks
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        picture = file.parent / frame["file_path"]
        write_heic(picture.with_suffix(".heic"), Image.open(picture))
        picture.unlink()
        frame["file_path"] = Path(frame["file_path"]).with_suffix("").as_posix()
    file.write_text(json.dumps(content))
    found = view_files.read(file)
    assert [shot.image.suffix for shot in found.shots] == [".heic"] * 3
    np.testing.assert_array_equal(view_pictures.load(found, 1).masks, before)


def test_without_the_library_it_is_named(tmp_path: Path, cli: Cli, program: Cli) -> None:
    write_heic(tmp_path / "photo.heic", Image.fromarray(ramp()))
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "pi_heif.py").write_text("raise ImportError('as if it were not there')\n")
    words = ["from-image", "photo.heic", "--generator", "json:loads", "--allow-code"]
    done = program(*words, cwd=tmp_path, env={"PYTHONPATH": str(hidden)})
    assert done.returncode == 69
    assert done.stderr.count("\n") == 1
    assert "photo.heic" in done.stderr
    assert "pip install 'vorolight[images]'" in done.stderr
    # With it the picture is read, and what is wrong is what the function makes of it.
    assert cli(*words, cwd=tmp_path).returncode == 3
