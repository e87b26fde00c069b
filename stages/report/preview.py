"""The preview of an input: its surface, its interior voxels, and a slice through them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from ..artifacts import atomic
from ..artifacts.run_folder import RunFolder
from ..inputs.resolve import up_axis
from ..inputs.views.pictures import colours
from ..inputs.views.source import ViewSource
from ..mesh.geometry import fan_triangles
from ..mesh.model_frame import ModelFrame
from ..mesh.polygons import Floats, Ints
from ..mesh.topology import bad_edges
from ..render import image_file, raster
from ..render.cameras import visible
from ..render.views import COVERED
from .pictures import AZIMUTH

if TYPE_CHECKING:
    from ..artifacts.hdf5 import Arrays
    from ..inputs.source import Source

FOUND, WRONG, VOXEL, BAND = (
    np.array(rgb)
    for rgb in ((0.56, 0.72, 0.88), (0.86, 0.24, 0.20), (0.98, 0.75, 0.42), (0.90, 0.92, 0.95))
)
OUTLINE = np.array([0.10, 0.62, 0.32])
DOTS = 30_000
"""Number of points of a cloud that are drawn, and of samples of a field."""


def write(folder: RunFolder, source: Source) -> Path:
    """Draw the picture next to the manifest of stage classify, and return its path."""
    path = folder.file("classify", "png")
    atomic.write(path, image_file.png(preview(source, folder.arrays("classify", "classify"))))
    return path


def preview(source: Source, classified: Arrays, size: int = 480) -> Floats:
    """Three panels ``(H, 3 H, 3)``: the input, with what is wrong in it in red, of views four
    pictures with the outline of the surface; its interior voxels; and the middle slice of the
    grid, interior voxels, their band and the surface."""
    views = source if isinstance(source, ViewSource) else None
    up = views.up if views else up_axis(None if source.path is None else str(source.path))
    view = raster.view(up, AZIMUTH[up])
    frame = ModelFrame.of(classified)
    panels = [
        _photographs(views, size)
        if views
        else raster.shaded(*_input(source, frame), view, size, size),
        raster.shaded(*_voxels(classified["interior"]), view, size, size),
        _slice(source, frame, classified, "xyz".index(up), size),
    ]
    return np.concatenate(panels, axis=1)


def _photographs(source: ViewSource, size: int) -> Floats:
    """Four of the pictures, where the surface covers them outlined: red where the mask does not."""
    half = size // 2
    panel = np.ones((size, size, 3))
    count = len(source.names)
    for place, view in enumerate(np.unique(np.arange(4) * count // 4)):
        camera, mask = source.views.cameras[view], source.views.masks[view] >= COVERED
        seen = visible(camera, camera.project(source.vertices), source.triangles) >= 0
        picture = colours(source.found.shots[view]).astype(np.float64)
        height, width = mask.shape
        step = max(height, width) / (half - 4)
        rows, columns = (
            np.minimum((np.arange(int(side / step)) * step).astype(int), side - 1)
            for side in (height, width)
        )
        near = seen ^ binary_erosion(seen, iterations=max(1, round(1.5 * step)))
        off = binary_dilation(near & ~mask, iterations=max(1, round(step)))
        picture[near] = OUTLINE
        picture[off & near] = WRONG
        top, left = (place // 2) * half + 2, (place % 2) * half + 2
        panel[top : top + len(rows), left : left + len(columns)] = picture[np.ix_(rows, columns)]
    return panel


def _input(source: Source, frame: ModelFrame) -> tuple[Floats, Ints, Ints | None, Floats]:
    """Vertices, triangles, outlined groups and colours."""
    mesh, measured = source.given_polygons(), source.measured_points()
    if mesh is not None:
        vertices, triangles, face = fan_triangles(mesh)
        bad = np.zeros(len(vertices), dtype=bool)
        bad[bad_edges(mesh).reshape(-1)] = True
        wrong = bad[triangles].sum(axis=1) > 1
        return vertices, triangles, face, np.where(wrong[:, None], WRONG, FOUND)
    if measured is not None:
        points = frame.model_from_input(measured.points)
        out = ~measured.kept
        step = max(1, len(points) // DOTS)
        chosen = np.unique(np.concatenate([np.arange(0, len(points), step), np.flatnonzero(out)]))
        edge = max(0.08, 0.5 * measured.spacing / frame.spacing)
        return _dots(points[chosen], out[chosen], edge)
    surface = source.true_surface(frame, 1)
    return _dots(surface.samples, np.zeros(len(surface.samples), dtype=bool), 0.15)


def _dots(
    points: Floats, wrong: NDArray[np.bool_], edge: float
) -> tuple[Floats, Ints, None, Floats]:
    """A tetrahedron at each point."""
    corner = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    face = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    vertices = (points[:, None] + 0.5 * edge * corner).reshape(-1, 3)
    triangles = (4 * np.arange(len(points))[:, None, None] + face).reshape(-1, 3)
    colour = np.where(np.repeat(wrong, 4)[:, None], WRONG, FOUND)
    return vertices, triangles, None, colour


def _voxels(interior: NDArray[np.bool_]) -> tuple[Floats, Ints, Ints, Floats]:
    """The squares between interior voxels and others."""
    padded = np.pad(interior, 1)
    corners = []
    for axis in range(3):
        first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        square = np.array([0 * first, first, first + second, second])
        before, after = (
            np.moveaxis(np.moveaxis(padded, axis, 0)[part], 0, axis)
            for part in (slice(None, -1), slice(1, None))
        )
        for outside, ring in ((after & ~before, square[::-1]), (before & ~after, square)):
            index = np.argwhere(outside).astype(np.float64) - 1
            index[:, axis] += 1
            corners.append(index[:, None] + ring)
    quads = np.concatenate(corners)
    first_corner = 4 * np.arange(len(quads))[:, None]
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    triangles = np.concatenate([first_corner + half for half in halves])
    group = np.tile(np.arange(len(quads)), 2)
    return quads.reshape(-1, 3), triangles, group, np.tile(VOXEL, (len(triangles), 1))


def _slice(source: Source, frame: ModelFrame, classified: Arrays, up: int, size: int) -> Floats:
    """Seen along the second of the axes that are level; ``up`` is upward."""
    along = next(axis for axis in (1, 2, 0) if axis != up)
    across = 3 - up - along
    interior, band = classified["interior"], classified["exterior"]
    occupied = np.flatnonzero(interior.any(axis=tuple(a for a in range(3) if a != along)))
    middle = int(occupied[len(occupied) // 2])
    most = max(interior.shape)
    pixel = (np.arange(size) + 0.5) / size * most
    place = np.zeros((size, size, 3))
    place[..., along] = middle + 0.5
    place[..., across] = pixel[None, :] - 0.5 * (most - interior.shape[across])
    place[..., up] = pixel[::-1, None] - 0.5 * (most - interior.shape[up])
    index = np.floor(place).astype(np.int64)
    there = ((index >= 0) & (index < interior.shape)).all(axis=2)
    index = np.where(there[..., None], index, 0)
    image = np.ones((size, size, 3))
    image[there & band[tuple(np.moveaxis(index, 2, 0))]] = BAND
    image[there & interior[tuple(np.moveaxis(index, 2, 0))]] = VOXEL
    inside = source.inside(frame.input_from_model(place.reshape(-1, 3))).reshape(size, size)
    line = np.zeros((size, size), dtype=bool)
    line[:, 1:] |= inside[:, 1:] != inside[:, :-1]
    line[1:] |= inside[1:] != inside[:-1]
    image[line] = raster.LINE
    return image
