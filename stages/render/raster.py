"""Visibility by z-buffer and the pictures made of it; orthographic, on the CPU, no display."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface.polygons import Floats, Ints

FRAGMENTS_AT_ONCE = 4_000_000
SUPERSAMPLING = 2
BACKGROUND = np.array([1.0, 1.0, 1.0])
NIGHT = np.array([0.045, 0.05, 0.075])
LINE = np.array([0.16, 0.17, 0.22])


@dataclass(frozen=True)
class View:
    """An orthographic camera looking along ``-direction`` with ``up`` upward."""

    direction: Floats
    up: Floats

    def frame(self) -> Floats:
        """Rows: right, up, towards the viewer."""
        towards = self.direction / np.linalg.norm(self.direction)
        right = np.cross(self.up, towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])


def view(up: str, azimuth: float = 35.0, elevation: float = 18.0) -> View:
    """A camera for an object whose ``up`` axis is x, y or z, maybe with a minus; in degrees."""
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
    """Per pixel: the triangle seen ``(H, W)``, -1 for none, and its depth towards the viewer."""

    triangle: Ints
    depth: Floats
    pixel: float
    """Edge of a pixel in the model's unit."""


def rasterize(vertices: Floats, triangles: Ints, camera: View, width: int, height: int) -> Visible:
    """Which triangle each pixel centre sees, the whole object fitted into the picture.

    Triangles turned away are skipped: the surfaces here are closed and face outward.
    """
    placed = vertices @ camera.frame().T
    low, high = placed[:, :2].min(axis=0), placed[:, :2].max(axis=0)
    size = np.array([width, height])
    scale = float((0.92 * size / np.maximum(high - low, 1e-300)).min())
    screen = (placed[:, :2] - 0.5 * (low + high)) * scale * [1, -1] + 0.5 * size
    corners, depths = screen[triangles], placed[triangles, 2]
    first = np.clip(np.ceil(corners.min(axis=1) - 0.5), 0, size).astype(np.int64)
    last = np.clip(np.floor(corners.max(axis=1) - 0.5), -1, size - 1).astype(np.int64)
    extent = np.maximum(last - first + 1, 0)
    count = extent.prod(axis=1)
    seen = np.full(width * height, -1, dtype=np.int64)
    nearest = np.full(width * height, -np.inf)
    arms = np.diff(corners, axis=1)
    facing = arms[:, 0, 0] * arms[:, 1, 1] - arms[:, 0, 1] * arms[:, 1, 0] < 0
    order = np.flatnonzero((count > 0) & facing)
    total = np.cumsum(count[order])
    at = 0
    while at < len(order):
        done = total[at - 1] if at else 0
        stop = max(at + 1, int(np.searchsorted(total, done + FRAGMENTS_AT_ONCE, side="right")))
        part = order[at:stop]
        owner = np.repeat(part, count[part])
        within = np.arange(len(owner)) - np.repeat(
            np.cumsum(count[part]) - count[part], count[part]
        )
        x = first[owner, 0] + within % extent[owner, 0]
        y = first[owner, 1] + within // extent[owner, 0]
        _paint(corners, depths, owner, x, y, width, seen, nearest)
        at = stop
    return Visible(seen.reshape(height, width), nearest.reshape(height, width), 1 / scale)


def _paint(
    corners: Floats, depths: Floats, owner: Ints, x: Ints, y: Ints, width: int, seen: Ints,
    nearest: Floats,
) -> None:  # fmt: skip
    a, b, c = corners[owner, 0], corners[owner, 1], corners[owner, 2]
    px, py = x + 0.5, y + 0.5

    def side(p: Floats, q: Floats) -> Floats:
        return (q[:, 0] - p[:, 0]) * (py - p[:, 1]) - (q[:, 1] - p[:, 1]) * (px - p[:, 0])

    wa, wb, wc = side(b, c), side(c, a), side(a, b)
    area = wa + wb + wc
    hit = (area < 0) & (wa <= 0) & (wb <= 0) & (wc <= 0)
    owner, area = owner[hit], area[hit]
    weights = np.stack([wa[hit], wb[hit], wc[hit]], axis=1) / area[:, None]
    depth = np.einsum("ij,ij->i", weights, depths[owner])
    pixel = y[hit] * width + x[hit]
    front = depth > nearest[pixel]
    owner, depth, pixel = owner[front], depth[front], pixel[front]
    order = np.argsort(depth, kind="stable")  # of equal pixels the last assignment stays
    nearest[pixel[order]] = depth[order]
    seen[pixel[order]] = owner[order]


def _normals(vertices: Floats, triangles: Ints) -> Floats:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1)


def _occlusion(visible: Visible) -> Floats:
    """Darkening of pixels that lie behind their surroundings, 0 to 1."""
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
    """Pixels whose right or lower neighbour belongs to another group."""
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

    ``groups (T,)`` are the polygons of the triangles, outlined where they meet (None: no lines);
    ``colors (T, 3)`` or ``(3,)``.
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
    """A picture of a lattice at night with a warm light at ``lamp`` inside it.

    The light casts no shadows: what faces it glows, what turns away stays dim.
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
