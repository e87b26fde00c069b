"""Calibrated views of an object: cameras, masks and normal maps of one size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from .cameras import Camera

UNIT = 32767
"""The length of a unit normal as it is stored."""
MOST_VIEWS = 66
"""Largest number of views that one training step uses (the paper's number)."""
COVERED = 128
"""The value of a mask, out of 255, from which on a pixel belongs to the object."""


@dataclass(frozen=True)
class Views:
    """N views of one object.

    ``masks (N, H, W) uint8`` are 255 where the object covers a pixel.
    ``normals (N, H, W, 3) int16`` are unit normals in the coordinates of the object, times UNIT,
    and zero where a pixel has none.
    """

    cameras: tuple[Camera, ...]
    masks: NDArray[np.uint8]
    normals: NDArray[np.int16] | None
    notes: tuple[str, ...] = ()
    """Assumptions that were made when the views were read, one sentence each."""

    def __len__(self) -> int:
        return len(self.cameras)

    def in_frame(self, origin: Floats, spacing: float) -> Views:
        """The same views for coordinates ``(x - origin) / spacing``."""
        return replace(
            self, cameras=tuple(camera.in_frame(origin, spacing) for camera in self.cameras)
        )

    def shrunk(self, factor: int) -> Views:
        """The views at a size that is divided by ``factor``. The size must be a multiple of it."""
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
    """The means of ``values (N, H, W, k)`` over blocks of ``factor`` by ``factor`` pixels."""
    count, height, width, depth = values.shape
    height, width = height // factor, width // factor
    result = np.zeros((count, height, width, depth), np.float32)
    for row in range(factor):
        for column in range(factor):
            result += values[
                :, row : height * factor : factor, column : width * factor : factor
            ].astype(np.float32)
    return result / np.float32(factor**2)
