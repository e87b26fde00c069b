"""Interior and exterior voxels of a shape (paper, appendix C.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .polygons import Floats, Ints

BAND = 3
"""Thickness of the layer of exterior voxels around the interior ones, in voxels."""


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels. ``origin (3,)`` is the lower corner of voxel (0, 0, 0), ``spacing`` is h0."""

    origin: Floats
    spacing: float
    interior: NDArray[np.bool_]
    exterior: NDArray[np.bool_]

    def centres(self, index: Ints) -> Floats:
        """The centres ``(N, 3)`` of the voxels ``index (N, 3)``."""
        return self.origin + (index + 0.5) * self.spacing


def exterior_band(interior: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``M_ext`` of the paper: the BAND layers of face neighbours around the ``interior`` voxels."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(interior, iterations=BAND) & ~interior)
