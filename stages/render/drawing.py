"""Colour, coverage and normals of a coloured mesh, as a camera sees them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.geometry import triangle_normals
from ..mesh.polygons import Floats, Ints
from .cameras import Camera

Colours = Callable[[Ints, Floats], Floats]
"""A function that gives RGB ``(N, 3)``, from 0 to 1, at N points of triangles. Its arguments are
the triangles ``(N,)`` and the barycentric weights ``(N, 3)`` of the points."""


@dataclass(frozen=True)
class Fragments:
    """The N points at which rays through pixel centres first meet a mesh."""

    rows: Ints
    columns: Ints
    triangle: Ints
    weights: Floats
    """Barycentric weights ``(N, 3)`` of the points in their triangles."""


def fragments(vertices: Floats, triangles: Ints, camera: Camera, both: bool = True) -> Fragments:
    """The fragments of triangles that face the camera or, with ``both``, of all triangles."""
    from . import visibility

    screen = camera.project(vertices)
    seen = np.empty((camera.height, camera.width), np.int64)
    nearest = np.empty((camera.height, camera.width))
    visibility.paint(screen, triangles, both, not camera.orthographic, seen, nearest)
    rows, columns = np.nonzero(seen >= 0)
    triangle = seen[rows, columns]
    corner = screen[triangles[triangle]]
    x, y = columns + 0.5, rows + 0.5
    a, b, c = (corner[:, k] for k in range(3))

    def doubled(p: Floats, q: Floats) -> Floats:
        return (q[:, 0] - p[:, 0]) * (y - p[:, 1]) - (q[:, 1] - p[:, 1]) * (x - p[:, 0])

    weights = np.stack([doubled(b, c), doubled(c, a), doubled(a, b)], axis=1)
    if not camera.orthographic:  # weights in the picture are not those in space
        weights = weights * corner[:, :, 2]
    weights = weights / weights.sum(axis=1, keepdims=True)
    return Fragments(rows, columns, triangle, weights)


def draw(
    vertices: Floats,
    triangles: Ints,
    colours: Colours | None,
    camera: Camera,
    samples: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """RGBA ``(H, W, 4)`` and unit normals ``(H, W, 3)``, both zero outside the object.

    ``samples`` by ``samples`` rays are cast for each pixel. Without ``colours`` the mesh is grey
    and lit from the camera.
    """
    matrix = camera.matrix.copy()
    matrix[:2] *= samples
    fine = Camera(
        samples * camera.width, samples * camera.height, matrix, camera.rotation,
        camera.translation, camera.orthographic,
    )  # fmt: skip
    hit = fragments(vertices, triangles, fine)
    centres = np.column_stack([hit.columns, hit.rows]).astype(np.float64) + 0.5
    normal = triangle_normals(vertices, triangles)[0][hit.triangle]
    facing: Floats = -np.einsum("ij,ij->i", normal, fine.rays(centres))
    normal = np.where(facing[:, None] < 0, -normal, normal)
    if colours is None:
        colour = np.repeat((0.2 + 0.6 * np.abs(facing))[:, None], 3, axis=1)
    else:
        colour = colours(hit.triangle, hit.weights)
    pixel = hit.rows // samples * camera.width + hit.columns // samples
    count = np.bincount(pixel, minlength=camera.width * camera.height)
    sums = [np.bincount(pixel, channel, minlength=len(count)) for channel in (*colour.T, *normal.T)]
    mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
    size = np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    normals = mean[:, 3:] / np.where(size > 0, size, 1)
    rgba = np.column_stack([mean[:, :3], count / samples**2])
    shape = (camera.height, camera.width, -1)
    return rgba.reshape(shape), normals.reshape(shape)
