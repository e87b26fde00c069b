"""Calibrated cameras, which map points to pixels and pixels to rays.

Camera axes are those of OpenCV: x to the right, y down, z forward. The centre of the pixel in row i
and column j is at (j + 1/2, i + 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..mesh.polygons import Floats, Ints

RIGID = 1e-3
"""The largest entry of ``R R^T - 1`` at which a matrix R still counts as a rotation."""


@dataclass(frozen=True)
class Camera:
    """A pinhole or orthographic camera.

    A point x has the camera coordinates ``c = rotation x + translation``. Its pixel is
    ``matrix (c / c_z)``, or ``matrix (c_x, c_y, 1)`` if the camera is orthographic.
    """

    width: int
    height: int
    matrix: Floats
    """The intrinsic matrix ``K (3, 3)``, upper triangular, in pixels. For an orthographic camera
    its unit is pixels per unit of length."""
    rotation: Floats
    translation: Floats
    orthographic: bool = False

    def placed(self, points: Floats) -> Floats:
        """Coordinates ``(N, 3)`` of ``points (N, 3)`` in the camera's axes."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def project(self, points: Floats) -> Floats:
        """Pixel coordinates u, v and inverse depth ``(N, 3)`` of ``points (N, 3)``.

        The third column is ``1 / c_z``, or ``-c_z`` if the camera is orthographic. It grows towards
        the camera, and it is linear over the picture of a plane. It is not positive behind a
        perspective camera.
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
        """Derivatives ``(N, 2, 3)`` of the pixel coordinates by the coordinates
        of ``points (N, 3)``."""
        at = self.placed(points)
        flat = np.zeros((len(points), 2, 3))
        flat[:, 0, 0] = flat[:, 1, 1] = 1.0
        if not self.orthographic:
            flat[:, :, 2] = -at[:, :2] / at[:, 2:]
            flat /= at[:, 2, None, None]
        return np.asarray(self.matrix[:2, :2] @ flat @ self.rotation)

    def size_of_pixel(self, points: Floats) -> Floats:
        """The length ``(N,)`` that one pixel covers at ``points (N, 3)``."""
        focal = np.sqrt(np.abs(self.matrix[0, 0] * self.matrix[1, 1]))
        if self.orthographic:
            return np.full(len(points), 1 / focal)
        return np.asarray(self.placed(points)[:, 2] / focal)

    @property
    def position(self) -> Floats:
        """The centre ``(3,)`` of a perspective camera."""
        return np.asarray(-self.rotation.T @ self.translation)

    def rays(self, pixels: Floats) -> Floats:
        """Unit vectors ``(N, 3)`` along the rays through ``pixels (N, 2)``."""
        if self.orthographic:
            return np.tile(self.rotation[2], (len(pixels), 1))
        flat = (pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T
        ray = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))

    def pixel_centres(self) -> Floats:
        """The centres ``(H W, 2)`` of all pixels, row by row."""
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
        """The camera of pictures whose pixels are blocks of ``factor`` by ``factor`` of these."""
        matrix = self.matrix.copy()
        matrix[:2] /= factor
        return replace(
            self, width=self.width // factor, height=self.height // factor, matrix=matrix
        )


def rigid(rotation: Floats) -> bool:
    """Whether ``rotation (3, 3)`` is orthonormal and right-handed."""
    if not np.isfinite(rotation).all():
        return False
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() < RIGID and np.linalg.det(rotation) > 0
    )


def looking(
    position: Floats, at: Floats, up: Floats, matrix: Floats, size: int, orthographic: bool
) -> Camera:
    """A camera at ``position`` that looks at ``at``. Its pictures have
    ``size`` by ``size`` pixels."""
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # a camera that looks along ``up`` needs another vector
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(size, size, matrix, rotation, -rotation @ position, orthographic)


def visible(camera: Camera, screen: Floats, triangles: Ints) -> Ints:
    """The triangle ``(H, W)`` of a closed surface that each pixel centre sees, -1 where it sees
    none.

    ``screen (V, 3)`` is what ``Camera.project`` gives for the vertices.
    """
    from . import visibility

    seen = np.empty((camera.height, camera.width), np.int64)
    nearest = np.empty((camera.height, camera.width))
    visibility.paint(screen, triangles, False, not camera.orthographic, seen, nearest)
    return seen


def facing(screen: Floats, triangles: Ints) -> Any:
    """Whether each triangle faces the camera, ``(T,)``. ``screen (V, 3)`` is as in ``visible``."""
    a, b, c = (screen[triangles[:, k], :2] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def ray_matrix(camera: Camera) -> Floats:
    """The matrix ``(3, 3)`` that maps (u, v, 1) to a vector along the ray through that pixel."""
    if camera.orthographic:
        return np.column_stack([np.zeros((3, 2)), camera.rotation[2]])
    return np.asarray(camera.rotation.T @ np.linalg.inv(camera.matrix))
