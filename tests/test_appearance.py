"""The shader, colours on surfaces, views on the command line, and one picture by six views."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from conftest import Cli, sphere_mesh
from PIL import Image

from vorolight.stages.artifacts import hdf5
from vorolight.stages.inputs.views import coloured, six_views
from vorolight.stages.inputs.views.writer import around
from vorolight.stages.render import drawing, image_file
from vorolight.stages.render.shader import Shader, coded, layers, shade
from vorolight.stages.shade import Geometry, split


def ball(path: Path, level: int = 4) -> Path:
    """A ball, its colours by place."""
    vertices, triangles = sphere_mesh(1.0, level)
    colours = np.column_stack([127.5 * (1 + vertices), np.full(len(vertices), 255)])
    mesh = trimesh.Trimesh(
        vertices, triangles, vertex_colors=np.rint(colours).astype(np.uint8), process=False
    )
    mesh.export(path)
    return path


def test_positions_are_coded_and_colours_depend_on_all_three() -> None:
    position = torch.tensor([[0.25, -0.5, 0.0]])
    code = coded(position)[0]
    assert code.shape == (27,)
    np.testing.assert_allclose(code[:3], position[0])
    np.testing.assert_allclose(code[3:6], np.sin(np.pi * np.array([0.25, -0.5, 0.0])), atol=1e-6)
    np.testing.assert_allclose(code[-3:], np.cos(8 * np.pi * position[0].numpy()), atol=1e-5)
    weights = layers(16, np.random.default_rng(0))
    at = [torch.randn(50, 3) for _ in range(3)]
    first = shade(weights, *at)
    assert first.shape == (50, 3)
    assert first.min() > 0
    assert first.max() < 1
    for k in range(3):
        moved = list(at)
        moved[k] = moved[k] + 0.5
        assert (shade(weights, *moved) - first).abs().max() > 1e-3
    shader = Shader({k: v.numpy() for k, v in weights.items()}, np.array([1.0, 0, 0]), 2.0)
    points, normal, ray = (part.numpy().astype(np.float64) for part in at)
    np.testing.assert_allclose(shader(2 * points + [1, 0, 0], normal, ray), first, atol=1e-6)


def test_what_no_camera_sees_is_known() -> None:
    vertices, triangles = sphere_mesh(1.0, 4)
    geometry = Geometry(vertices, triangles, vertices)
    (first, *_) = cameras = around(np.zeros(3), 1.2, 6, 128, True, 0)
    assert geometry.unseen([first]) == pytest.approx(0.5, abs=0.05)
    assert geometry.unseen(cameras) == 0


def test_views_are_held_out_evenly() -> None:
    trained, held = split(66, None)
    assert len(held) == 8
    assert len(trained) == 58
    assert np.diff(held).min() >= 8
    assert len(split(6, None)[1]) == 0
    assert split(10, 3)[1].tolist() == [1, 5, 8]


def test_pictures_have_the_colours_of_texture_vertices_and_faces(tmp_path: Path) -> None:
    (tmp_path / "square.obj").write_text(
        "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    quarters = np.zeros((2, 2, 3), np.uint8)
    quarters[0, 0], quarters[0, 1], quarters[1, 0] = [255, 0, 0], [0, 255, 0], [0, 0, 255]
    texture = np.repeat(np.repeat(quarters, 32, 0), 32, 1)
    Image.fromarray(texture).save(tmp_path / "texture.png")
    mesh = coloured.load(tmp_path / "square.obj", tmp_path / "texture.png")
    middle = np.array([1.0, 1.0, 0.0])
    for orthographic in (True, False):
        cameras = around(middle, 1.5, 6, 64, orthographic, 0)
        rgba, normals = drawing.draw(mesh.vertices, mesh.triangles, mesh.colours, cameras[2], 2)
        row, column = np.nonzero(rgba[..., 3] == 1)
        pixels = np.column_stack([column, row]) + 0.5
        # Where the ray of a pixel meets the square, and its colour there.
        if orthographic:
            flat = (pixels - cameras[2].matrix[:2, 2]) / cameras[2].matrix[0, 0]
            at = middle + flat @ cameras[2].rotation[:2]
        else:
            ray = cameras[2].rays(pixels)
            at = cameras[2].position - ray * (cameras[2].position[2] / ray[:, 2])[:, None]
        expected = quarters[(at[:, 1] < 1).astype(int), (at[:, 0] > 1).astype(int)] / 255
        inner = (np.abs(at[:, :2] - 1) > 0.1).all(axis=1)
        np.testing.assert_allclose(rgba[row, column, :3][inner], expected[inner], atol=1e-6)
        np.testing.assert_allclose(normals[row, column], np.tile([0, 0, 1.0], (len(row), 1)))
    whole = ball(tmp_path / "ball.ply", 3)
    mesh = coloured.load(whole)
    assert mesh.colours is not None
    corner = np.tile([1.0, 0, 0], (len(mesh.triangles), 1))
    found = mesh.colours(np.arange(len(mesh.triangles)), corner)
    np.testing.assert_allclose(2 * found - 1, mesh.vertices[mesh.triangles[:, 0]], atol=0.01)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """Sixteen views of the ball, run to its appearance; the folder of the run."""
    folder = tmp_path_factory.mktemp("shaded")
    ball(folder / "ball.ply")
    words = ["views", "ball.ply", "-o", "seen", "--count", 16, "--size", 96, "--quiet"]
    assert cli(*words, cwd=folder).returncode == 0
    words = ["run", "seen", "-n", 8, "--until", "shade", "--shade-iterations", 600, "--width", 64,
             "--shade-render", "orbit", "--frames", 4, "--size", 64, "--inner", 10,
             "--cvt-iterations", 2, "--threads", 2, "--quiet"]  # fmt: skip
    done = cli(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "seen.vorolight"


def test_views_run_to_colours_on_the_surface(run: Path, cli: Cli) -> None:
    classified = json.loads((run / "classify.json").read_text())
    assert classified["inputs"][0]["kind"] == "views"
    assert classified["metrics"]["input"]["mask_overlap_worst"] > 0.97
    done = cli("evaluate", "--run", run, "--samples", 2000, cwd=run.parent)
    assert "overlap with masks, worst" in done.stdout
    evaluated = json.loads((run / "evaluate-sphere-train.json").read_text())["metrics"]
    assert evaluated["mask_overlap"]["worst"] > 0.95
    trained = json.loads((run / "sphere-train.json").read_text())["metrics"]
    assert trained["certificate"]["holds"]
    assert trained["topology"]["euler_number"] == 2
    shaded = json.loads((run / "shade.json").read_text())["metrics"]
    # Colours that change linearly over the ball are learned well within so few steps.
    assert shaded["held_out_psnr"] > 25
    assert len(shaded["held_out_views"]) == 2
    assert shaded["held_out_seen"] > 0.95
    assert shaded["unseen_share"] == 0
    mesh = trimesh.load(run / "shade.ply", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    place = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    found = np.asarray(mesh.visual.vertex_colors)[:, :3] / 127.5 - 1
    assert np.abs(found - place).mean() < 0.1
    glb = trimesh.load(run / "shade.glb", force="mesh", process=False)
    assert glb.is_watertight
    assert len(np.unique(np.asarray(glb.visual.vertex_colors), axis=0)) > 50
    arrays, _ = hdf5.read(run / "shade.h5", "shade")
    assert arrays["shader/position.0.weight"].shape == (64, 27)


def test_the_orbit_is_drawn(run: Path) -> None:
    names = sorted(path.name for path in run.glob("shade.orbit-*.png"))
    assert names == [f"shade.orbit-{k}.png" for k in range(4)]
    first, second = (image_file.read(run / name) / 255 for name in names[:2])
    assert first.shape == (64, 64, 3)
    covered = (first < 1).any(axis=2)
    assert 0.2 < covered.mean() < 0.6
    assert covered[32, 32]
    assert not covered[0, 0]
    assert np.abs(first - second).max() > 0.2
    with Image.open(run / "shade.gif") as animation:
        assert animation.n_frames == 4  # type: ignore[attr-defined]


def test_a_finished_run_outlives_its_pictures(run: Path, cli: Cli, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(run.parent, tmp_path / "all")
    (tmp_path / "all" / "seen" / "images" / "003.png").unlink()
    done = cli("report", "--run", "seen.vorolight", cwd=tmp_path / "all")
    assert done.returncode == 0, done.stderr
    done = cli("shade", "--run", "seen.vorolight", "--width", 16, cwd=tmp_path / "all")
    assert done.returncode == 3
    assert "003.png" in done.stderr


def test_only_views_have_an_appearance_and_masks(cli: Cli, heart_run: Path) -> None:
    done = cli("shade", "--run", heart_run, cwd=heart_run.parent)
    assert done.returncode == 2
    assert "shade: the input is of kind field, and only views have colours" in done.stderr
    done = cli("classify", "heart", "--mask-votes", 1, cwd=heart_run.parent, env={})
    assert done.returncode == 2
    assert "--mask-votes: needs views, but the input is of kind field" in done.stderr
    done = cli("init", "--run", heart_run, "--shape-loss", "images", cwd=heart_run.parent)
    assert done.returncode == 2
    assert "--shape-loss images: the input is of kind field" in done.stderr


def test_the_paper_trains_on_pictures(run: Path, cli: Cli, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(run.parent, tmp_path / "all")
    words = ["--init-iterations", 5, "--shape-loss", "images", "--run", "seen.vorolight"]
    folder = tmp_path / "all"
    done = cli("init", *[w if w != "--init-iterations" else "--iterations" for w in words],
               cwd=folder)  # fmt: skip
    assert done.returncode == 0, done.stderr
    done = cli("sphere-train", "--preset", "paper", "--faces", "polygon", "--iterations", 20,
               "--run", "seen.vorolight", cwd=folder)  # fmt: skip
    assert done.returncode == 0, done.stderr
    history = hdf5.read(folder / "seen.vorolight" / "sphere-train.h5", "sphere-train")[0]["history"]
    assert history[-1, 2] < history[0, 2]


def test_six_views_of_a_known_mesh(tmp_path: Path, cli: Cli) -> None:
    mesh = coloured.load(ball(tmp_path / "ball.ply", 5))
    vertices = mesh.vertices * [0.5, 0.4, 0.3] + np.array([0.05, 0.0, 0.02])
    made = tmp_path / "made"
    made.mkdir()
    for name, camera in zip(six_views.NAMES, six_views.cameras((128, 128)), strict=True):
        rgba, normals = drawing.draw(vertices, mesh.triangles, mesh.colours, camera, 2)
        (made / f"{name}.png").write_bytes(image_file.png(rgba))
        # As Hunyuan3D-2 has them: x, -z and y of a normal; white where there is none.
        turned = np.stack([normals[..., 0], -normals[..., 2], normals[..., 1]], axis=2)
        coded_ = np.where(rgba[..., 3:] > 0, 0.5 * turned + 0.5, 1.0)
        (made / f"{name}_normal.png").write_bytes(image_file.png(coded_))
    Image.open(made / "front.png").save(tmp_path / "photo.png")
    done = cli("from-image", "photo.png", cwd=tmp_path)
    assert done.returncode == 69
    assert "there is no built-in generator of six views" in done.stderr
    done = cli("from-image", "photo.png", "--six-views", "made", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].endswith("transforms.json")
    (tmp_path / "maker.py").write_text("def make(photo):\n    return photo.parent / 'made'\n")
    words = ["from-image", "photo.png", "--generator", "maker:make", "-o", "again"]
    done = cli(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert "add --allow-code if you trust it" in done.stderr
    done = cli(*words, "--allow-code", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first, second = (tmp_path / f / "transforms.json" for f in ("photo-views", "again"))
    assert first.read_bytes() == second.read_bytes()
    done = cli("classify", "photo-views", "-n", 10, "--quiet", "--preview", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "photo-views.vorolight" / "classify.png").is_file()
    arrays, _ = hdf5.read(tmp_path / "photo-views.vorolight" / "classify.h5", "classify")
    # On the ellipsoid that was drawn, to a few thousandths of its size.
    at = (arrays["source/vertices"] - [0.05, 0.0, 0.02]) / [0.5, 0.4, 0.3]
    assert np.abs(np.linalg.norm(at, axis=1) - 1).max() < 0.05
    assert np.abs(np.linalg.norm(at, axis=1) - 1).mean() < 0.01
    (made / "top_normal.png").unlink()
    done = cli("from-image", "photo.png", "--six-views", "made", "--force", cwd=tmp_path)
    assert done.returncode == 3
    assert "has 5 normal maps; give six or none" in done.stderr
