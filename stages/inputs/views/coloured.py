"""Meshes with their colours: textures, colours of vertices or of faces."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mesh.polygons import Floats, Ints
from ...render import image_file
from ...render.drawing import Colours


@dataclass(frozen=True)
class ColouredMesh:
    """Triangles, and the colours of points on them; None where the file has none."""

    vertices: Floats
    triangles: Ints
    colours: Colours | None


def load(path: Path, texture: Path | None = None) -> ColouredMesh:
    """The mesh in ``path`` with its texture, or the colours of its vertices or faces; ``texture``
    is a picture that takes the place of its own.

    Raises InputError for a file that is missing or holds no mesh, or no place for the texture.
    """
    import trimesh

    if not path.is_file():
        raise InputError(f"{path}: no such file; give a mesh")
    try:
        with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            mesh: Any = trimesh.load(path, process=False, force="mesh")
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        triangles = np.asarray(mesh.faces, dtype=np.int64)
    # trimesh's loaders raise whatever their formats' parsers do.
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable mesh ({reason[:120]})") from error
    if len(triangles) == 0:
        raise InputError(f"{path}: holds no triangles; give a mesh")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: has coordinates that are not finite; repair the mesh")
    places = getattr(mesh.visual, "uv", None)
    if texture is not None:
        if places is None:
            raise InputError(f"{path}: has no texture coordinates; leave --texture out")
        picture = image_file.read(texture)
        return ColouredMesh(vertices, triangles, _textured(places[triangles], picture))
    return ColouredMesh(vertices, triangles, _colours(mesh, triangles))


def _colours(mesh: Any, triangles: Ints) -> Colours | None:
    visual = mesh.visual
    if visual.kind == "texture" and visual.uv is not None:
        image = getattr(visual.material, "image", None)
        if image is None:
            image = getattr(visual.material, "baseColorTexture", None)
        if image is not None:
            return _textured(visual.uv[triangles], np.asarray(image.convert("RGB")))
    if visual.kind == "vertex":
        corner = np.asarray(visual.vertex_colors, dtype=np.float64)[triangles][..., :3] / 255
        return lambda triangle, weights: np.einsum("ni,nij->nj", weights, corner[triangle])
    if visual.kind == "face":
        face = np.asarray(visual.face_colors, dtype=np.float64)[:, :3] / 255
        return lambda triangle, weights: face[triangle]
    return None


def _textured(corner: Any, image: NDArray[np.uint8]) -> Colours:
    """``corner (T, 3, 2)`` in the texture, whose lower left is (0, 0); it repeats."""
    corner = np.asarray(corner, dtype=np.float64)
    texture = image.astype(np.float64) / 255
    if texture.ndim == 2:
        texture = np.repeat(texture[..., None], 3, axis=2)
    texture = texture[..., :3]
    height, width, _ = texture.shape

    def colours(triangle: Ints, weights: Floats) -> Floats:
        u, v = np.einsum("ni,nij->nj", weights, corner[triangle]).T
        x, y = u * width - 0.5, (1 - v) * height - 0.5
        j, i = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        s, t = (x - j)[:, None], (y - i)[:, None]
        rows, columns = (i % height, (i + 1) % height), (j % width, (j + 1) % width)
        return np.asarray(
            (1 - t) * ((1 - s) * texture[rows[0], columns[0]] + s * texture[rows[0], columns[1]])
            + t * ((1 - s) * texture[rows[1], columns[0]] + s * texture[rows[1], columns[1]])
        )

    return colours
