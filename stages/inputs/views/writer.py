"""Writing sets of views: pictures with alpha, normal maps and transforms.json, from a mesh."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...artifacts import atomic
from ...errors import UsageError
from ...mesh.polygons import Floats
from ...render import drawing, image_file
from ...render.cameras import Camera, looking
from ..resolve import up_axis
from .coloured import load

FILLED = 0.95
"""Of half a picture, taken by the sphere around the mesh."""
FAR = 3.0
"""Distance of perspective cameras from the middle, in radii of that sphere."""
SAMPLES = 2
"""Rays a pixel, along each side."""
AXES = 6

Projection = Literal["perspective", "orthographic"]


def write_views(
    mesh: Path,
    folder: Path,
    count: int,
    size: int,
    projection: Projection | None,
    seed: int,
    force: bool,
    threads: int,
    tick: Callable[[int], None] = lambda done: None,
    texture: Path | None = None,
) -> Path:
    """Draw ``count`` views of ``size`` by ``size`` pixels into ``folder``; its transforms.json.

    Six are those along the axes, by default orthographic; any other number is spread at random
    over a sphere, by default in perspective. Raises InputError for a bad mesh, UsageError where
    there is a set already and not ``force``.
    """
    target = folder / "transforms.json"
    if target.exists() and not force:
        raise UsageError(f"{target}: a set of views exists there; replace it with --force")
    loaded = load(mesh, texture)
    vertices, triangles = loaded.vertices, loaded.triangles
    used = vertices[np.unique(triangles)]
    middle = 0.5 * (used.min(axis=0) + used.max(axis=0))
    radius = float(np.linalg.norm(used - middle, axis=1).max())
    orthographic = (projection or ("orthographic" if count == AXES else "perspective")) != (
        "perspective"
    )
    cameras = around(middle, radius, count, size, orthographic, seed, up_axis(str(mesh)))
    target.unlink(missing_ok=True)
    for name in ("images", "normals"):
        atomic.make_folder(folder / name)

    def one(number: int) -> None:
        rgba, normals = drawing.draw(vertices, triangles, loaded.colours, cameras[number], SAMPLES)
        atomic.write(folder / "images" / f"{number:03d}.png", image_file.png(rgba))
        coded = np.where(rgba[..., 3:] > 0, 0.5 * normals + 0.5, 0.5)
        atomic.write(folder / "normals" / f"{number:03d}.png", image_file.png(coded))

    with ThreadPoolExecutor(threads) as pool:
        for done, _ in enumerate(pool.map(one, range(len(cameras)))):
            tick(done + 1)
    write_transforms(
        target,
        cameras,
        [
            {
                "file_path": f"images/{number:03d}.png",
                "normal_file_path": f"normals/{number:03d}.png",
            }
            for number in range(len(cameras))
        ],
    )
    return target


def around(
    middle: Floats,
    radius: float,
    count: int,
    size: int,
    orthographic: bool,
    seed: int,
    up: str = "z",
) -> list[Camera]:
    """Cameras that look at a sphere from the six axes, or from ``count`` random sides; ``up`` is
    the axis that points up in the pictures."""
    if count == AXES:
        sides = np.concatenate([np.eye(3), -np.eye(3)])
    else:
        sides = np.random.default_rng(seed).standard_normal((count, 3))
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    focal = 0.5 * size * FILLED / radius
    if not orthographic:
        focal *= radius * np.sqrt(FAR**2 - 1)
    matrix = np.array([[focal, 0, 0.5 * size], [0, focal, 0.5 * size], [0, 0, 1.0]])
    upward = np.eye(3)["xyz".index(up)]
    return [
        looking(middle + FAR * radius * side, middle, upward, matrix, size, orthographic)
        for side in sides
    ]


def write_transforms(
    path: Path, cameras: Iterable[Camera], frames: Iterable[dict[str, Any]], space: str = "world"
) -> None:
    """A nerfstudio transforms.json; ``frames`` hold the files of each camera."""
    described = []
    for camera, frame in zip(cameras, frames, strict=True):
        outer = np.eye(4)
        outer[:3, :3] = camera.rotation.T * [1.0, -1.0, -1.0]
        outer[:3, 3] = camera.position
        described.append(
            {
                **frame,
                "fl_x": camera.matrix[0, 0],
                "fl_y": camera.matrix[1, 1],
                "cx": camera.matrix[0, 2],
                "cy": camera.matrix[1, 2],
                "w": camera.width,
                "h": camera.height,
                "transform_matrix": outer.tolist(),
            }
        )
        model = "ORTHOGRAPHIC" if camera.orthographic else "PINHOLE"
    content = {"camera_model": model, "normal_space": space, "frames": described}
    atomic.write(path, (json.dumps(content, indent=1) + "\n").encode())
