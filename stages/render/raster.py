"""Pictures by z-buffer with an orthographic camera, on the CPU and without a display."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints

SUPERSAMPLING = 2
BACKGROUND = np.array([1.0, 1.0, 1.0])
NIGHT = np.array([0.045, 0.05, 0.075])
LINE = np.array([0.16, 0.17, 0.22])


@dataclass(frozen=True)
class View:
    """An orthographic camera that looks along ``-direction``; ``up`` is upward in its pictures."""

    direction: Floats
    up: Floats

    def frame(self) -> Floats:
        """Unit vectors as rows ``(3, 3)``: to the right, upward, and towards the viewer."""
        towards = self.direction / np.linalg.norm(self.direction)
        right = np.cross(self.up, towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])


def view(up: str, azimuth: float = 35.0, elevation: float = 18.0) -> View:
    """A camera for an object whose upward axis is ``up``: x, y or z, with a minus if it points
    down.

    ``azimuth`` and ``elevation`` are in degrees.
    """
    axis = "xyz".index(up[-1])
    sign = -1.0 if up.startswith("-") else 1.0
    vertical, first, second = np.zeros(3), np.zeros(3), np.zeros(3)
    vertical[axis] = sign
    first[(axis + 1) % 3] = 1.0
    second[(axis + 2) % 3] = 1.0
    turn, rise = np.radians(azimuth), np.radians(elevation)
    direction = np.cos(rise) * (np.cos(turn) * first + np.sin(turn) * second)
    direction = direction + np.sin(rise) * vertical
    return View(direction, vertical)


@dataclass(frozen=True)
class Visible:
    """What each pixel shows: the triangle ``(H, W)``, -1 for none, and its depth ``(H, W)``, which
    grows towards the viewer."""

    triangle: Ints
    depth: Floats
    pixel: float
    """Edge of a pixel, in the unit of the model."""


def rasterize(vertices: Floats, triangles: Ints, camera: View, width: int, height: int) -> Visible:
    """The triangle that each pixel centre sees when the whole object is fitted into the picture.

    Triangles that face away are skipped, because the surfaces here are closed and face outward.
    """
    from . import visibility

    placed = vertices @ camera.frame().T
    low, high = placed[:, :2].min(axis=0), placed[:, :2].max(axis=0)
    size = np.array([width, height])
    scale = float((0.92 * size / np.maximum(high - low, 1e-300)).min())
    screen = (placed[:, :2] - 0.5 * (low + high)) * scale * [1, -1] + 0.5 * size
    seen, nearest = np.empty((height, width), np.int64), np.empty((height, width))
    visibility.paint(
        np.column_stack([screen, placed[:, 2]]), triangles, False, False, seen, nearest
    )
    return Visible(seen, nearest, 1 / scale)


def _normals(vertices: Floats, triangles: Ints) -> Floats:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1)


def _occlusion(visible: Visible) -> Floats:
    """How much each pixel is darkened, from 0 to 1, because it lies behind its surroundings."""
    from scipy.ndimage import gaussian_filter

    solid = visible.triangle >= 0
    span = max(visible.triangle.shape) * visible.pixel
    depth = np.where(solid, visible.depth, 0.0)
    dark = np.zeros(depth.shape)
    for share in (0.004, 0.012, 0.03):
        sigma = share * max(visible.triangle.shape)
        weight = gaussian_filter(solid.astype(float), sigma)
        around = gaussian_filter(depth, sigma) / np.maximum(weight, 1e-6)
        dark += np.clip((around - depth) / (2.5 * share * span), 0, 1) / 3
    return np.where(solid, dark, 0.0)


def _outlines(group: Ints) -> NDArray[np.bool_]:
    """The pixels whose right or lower neighbour belongs to another group."""
    line = np.zeros(group.shape, dtype=bool)
    line[:, :-1] |= group[:, :-1] != group[:, 1:]
    line[:-1] |= group[:-1] != group[1:]
    return line


def _shrink(image: Floats) -> Floats:
    height, width, _ = image.shape
    step = SUPERSAMPLING
    blocks = image.reshape(height // step, step, width // step, step, 3)
    return np.asarray(blocks.mean(axis=(1, 3)))


def shaded(
    vertices: Floats,
    triangles: Ints,
    groups: Ints | None,
    colors: Floats,
    camera: View,
    width: int = 640,
    height: int = 640,
) -> Floats:
    """A picture ``(height, width, 3)`` in daylight.

    ``groups (T,)`` is the polygon of each triangle, and lines are drawn where polygons meet; None
    draws no lines. ``colors`` is ``(T, 3)`` or ``(3,)``, from 0 to 1.
    """
    step = SUPERSAMPLING
    visible = rasterize(vertices, triangles, camera, width * step, height * step)
    solid = visible.triangle >= 0
    seen = visible.triangle[solid]
    frame = camera.frame()
    normal = _normals(vertices, triangles)[seen] @ frame.T
    key, fill = np.array([-0.45, 0.65, 0.61]), np.array([0.8, 0.1, 0.59])
    light = 0.30 + 0.62 * np.clip(normal @ key, 0, None) + 0.22 * np.clip(normal @ fill, 0, None)
    light *= 1 - 0.75 * _occlusion(visible)[solid]
    color = np.broadcast_to(colors, (len(triangles), 3))[seen]
    image = np.broadcast_to(BACKGROUND, (*solid.shape, 3)).copy()
    image[solid] = color * light[:, None]
    if groups is not None:
        line = _outlines(np.where(solid, groups[visible.triangle], -1)) & solid
        image[line] = 0.45 * image[line] + 0.55 * LINE
    return _shrink(np.clip(image, 0, 1))


def lit(
    vertices: Floats,
    triangles: Ints,
    lamp: tuple[float, float, float],
    camera: View,
    width: int = 640,
    height: int = 640,
) -> Floats:
    """A picture ``(height, width, 3)`` of an object at night, with a warm light at ``lamp`` inside
    it.

    The light casts no shadows: triangles that face it are bright, and the others are dim.
    """
    step = SUPERSAMPLING
    visible = rasterize(vertices, triangles, camera, width * step, height * step)
    solid = visible.triangle >= 0
    seen = visible.triangle[solid]
    normals = _normals(vertices, triangles)
    centres = vertices[triangles[seen]].mean(axis=1)
    ray = np.asarray(lamp) - centres
    reach = np.linalg.norm(ray, axis=1, keepdims=True)
    size = float(np.ptp(vertices, axis=0).max())
    facing = np.clip(np.einsum("ij,ij->i", ray / reach, normals[seen]), 0, 1)
    glow = (facing + 0.10) / (0.35 + (2.0 * reach[:, 0] / size) ** 2)
    view_normal = normals[seen] @ camera.frame().T
    sky = 0.05 + 0.06 * np.clip(view_normal[:, 1], 0, 1)
    warm, cold = np.array([1.0, 0.68, 0.33]), np.array([0.55, 0.65, 1.0])
    color = glow[:, None] * warm + (sky * (1 - 0.6 * _occlusion(visible)[solid]))[:, None] * cold
    image = np.broadcast_to(NIGHT, (*solid.shape, 3)).copy()
    image[solid] = 1 - np.exp(-1.35 * color)
    return _shrink(_bloom(image))


def _bloom(image: Floats) -> Floats:
    from scipy.ndimage import gaussian_filter

    bright = np.clip(image - 0.35, 0, None)
    sigma = 0.018 * max(image.shape)
    halo = np.stack([gaussian_filter(bright[..., k], sigma) for k in range(3)], axis=-1)
    return np.asarray(np.clip(image + 0.55 * halo, 0, 1))
