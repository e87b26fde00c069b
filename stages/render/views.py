"""Calibrated views of an object: cameras, masks and normals, of one size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from .cameras import Camera

UNIT = 32767
"""Length of a stored unit normal."""
MOST_VIEWS = 66
"""Views in a step, at most (the paper's number)."""
COVERED = 128
"""Of 255, from which a pixel of a mask belongs to the object."""


@dataclass(frozen=True)
class Views:
    """``masks (N, H, W) uint8``, 255 where the object covers a pixel; unit ``normals (N, H, W, 3)
    int16`` in the coordinates of the object, in units of 1 / UNIT, zero where there is none."""

    cameras: tuple[Camera, ...]
    masks: NDArray[np.uint8]
    normals: NDArray[np.int16] | None
    notes: tuple[str, ...] = ()
    """What was assumed when they were read, in sentences."""

    def __len__(self) -> int:
        return len(self.cameras)

    def in_frame(self, origin: Floats, spacing: float) -> Views:
        """For coordinates ``(x - origin) / spacing``."""
        return replace(
            self, cameras=tuple(camera.in_frame(origin, spacing) for camera in self.cameras)
        )

    def shrunk(self, factor: int) -> Views:
        """At a size divided by ``factor``, which must divide it."""
        if factor == 1:
            return self
        cameras = tuple(camera.shrunk(factor) for camera in self.cameras)
        normals = None
        if self.normals is not None:
            summed = _blocks(self.normals, factor)
            length = np.sqrt(np.einsum("nhwk,nhwk->nhw", summed, summed))[..., None]
            np.divide(summed, length, out=summed, where=length > 0)
            normals = np.rint(UNIT * summed).astype(np.int16)
        masks = np.rint(_blocks(self.masks[..., None], factor)[..., 0]).astype(np.uint8)
        return Views(cameras, masks, normals)


def _blocks(values: NDArray[np.generic], factor: int) -> NDArray[np.float32]:
    """Means over blocks of pixels of ``values (N, H, W, k)``."""
    count, height, width, depth = values.shape
    height, width = height // factor, width // factor
    result = np.zeros((count, height, width, depth), np.float32)
    for row in range(factor):
        for column in range(factor):
            result += values[
                :, row : height * factor : factor, column : width * factor : factor
            ].astype(np.float32)
    return result / np.float32(factor**2)
