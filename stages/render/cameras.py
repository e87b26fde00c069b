"""Calibrated cameras: from points to pixels and back.

Inside, axes are OpenCV's (x right, y down, z forward) and the centre of the pixel in row i and
column j is at (j + 1/2, i + 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..mesh.polygons import Floats, Ints

RIGID = 1e-3
"""How far a rotation may be from one, as an entry of R R^T - 1."""


@dataclass(frozen=True)
class Camera:
    """``c = rotation x + translation`` are a point's coordinates in the camera; its pixel is
    ``matrix (c / c_z)``, of an orthographic camera ``matrix (c_x, c_y, 1)``."""

    width: int
    height: int
    matrix: Floats
    """``K (3, 3)``, upper triangular, in pixels (orthographic: pixels a unit of length)."""
    rotation: Floats
    translation: Floats
    orthographic: bool = False

    def placed(self, points: Floats) -> Floats:
        """Coordinates ``(N, 3)`` of ``points`` in the camera's axes."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def project(self, points: Floats) -> Floats:
        """Pixel coordinates and nearness ``(N, 3)``: u, v, and what grows towards the camera and is
        linear over the image of a plane, ``1 / c_z`` or ``-c_z`` of an orthographic one.

        Behind a perspective camera the nearness is not positive.
        """
        at = self.placed(points)
        if self.orthographic:
            nearness, flat = -at[:, 2], at[:, :2]
        else:
            depth = np.where(np.abs(at[:, 2]) < 1e-12, -1e-12, at[:, 2])
            nearness, flat = 1 / depth, at[:, :2] / depth[:, None]
        pixel = flat @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        return np.column_stack([pixel, nearness])

    def jacobian(self, points: Floats) -> Floats:
        """Derivatives ``(N, 2, 3)`` of the pixel coordinates of ``points (N, 3)``."""
        at = self.placed(points)
        flat = np.zeros((len(points), 2, 3))
        flat[:, 0, 0] = flat[:, 1, 1] = 1.0
        if not self.orthographic:
            flat[:, :, 2] = -at[:, :2] / at[:, 2:]
            flat /= at[:, 2, None, None]
        return np.asarray(self.matrix[:2, :2] @ flat @ self.rotation)

    def size_of_pixel(self, points: Floats) -> Floats:
        """Length ``(N,)`` that a pixel covers at ``points (N, 3)``."""
        focal = np.sqrt(np.abs(self.matrix[0, 0] * self.matrix[1, 1]))
        if self.orthographic:
            return np.full(len(points), 1 / focal)
        return np.asarray(self.placed(points)[:, 2] / focal)

    @property
    def position(self) -> Floats:
        """Where a perspective camera is ``(3,)``."""
        return np.asarray(-self.rotation.T @ self.translation)

    def rays(self, pixels: Floats) -> Floats:
        """Unit vectors ``(N, 3)`` from the camera through ``pixels (N, 2)``."""
        if self.orthographic:
            return np.tile(self.rotation[2], (len(pixels), 1))
        flat = (pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T
        ray = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))

    def pixel_centres(self) -> Floats:
        """Of all pixels, row by row, ``(H W, 2)``."""
        row, column = np.divmod(np.arange(self.width * self.height), self.width)
        return np.column_stack([column, row]) + 0.5

    def in_frame(self, origin: Floats, spacing: float) -> Camera:
        """The same camera for coordinates ``(x - origin) / spacing``."""
        matrix = self.matrix.copy()
        if self.orthographic:
            matrix[:2, :2] *= spacing
        moved = self.rotation @ origin + self.translation
        return replace(self, matrix=matrix, translation=moved / spacing)

    def shrunk(self, factor: int) -> Camera:
        """For pictures whose pixels are blocks of ``factor`` by ``factor``."""
        matrix = self.matrix.copy()
        matrix[:2] /= factor
        return replace(
            self, width=self.width // factor, height=self.height // factor, matrix=matrix
        )


def rigid(rotation: Floats) -> bool:
    """Whether ``rotation (3, 3)`` is one: orthonormal and right-handed."""
    if not np.isfinite(rotation).all():
        return False
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() < RIGID and np.linalg.det(rotation) > 0
    )


def looking(
    position: Floats, at: Floats, up: Floats, matrix: Floats, size: int, orthographic: bool
) -> Camera:
    """A camera at ``position`` whose axis goes through ``at``, with square pictures."""
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # along the vertical any direction is to the right
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(size, size, matrix, rotation, -rotation @ position, orthographic)


def visible(camera: Camera, screen: Floats, triangles: Ints) -> Ints:
    """The triangle that each pixel centre sees ``(H, W)``, -1 for none; of a closed surface."""
    from . import visibility

    seen = np.empty((camera.height, camera.width), np.int64)
    nearest = np.empty((camera.height, camera.width))
    visibility.paint(screen, triangles, False, not camera.orthographic, seen, nearest)
    return seen


def facing(screen: Floats, triangles: Ints) -> Any:
    """Whether triangles are turned to the camera ``(T,)``."""
    a, b, c = (screen[triangles[:, k], :2] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def ray_matrix(camera: Camera) -> Floats:
    """``(3, 3)``: times (u, v, 1) it is along the ray through that pixel."""
    if camera.orthographic:
        return np.column_stack([np.zeros((3, 2)), camera.rotation[2]])
    return np.asarray(camera.rotation.T @ np.linalg.inv(camera.matrix))
