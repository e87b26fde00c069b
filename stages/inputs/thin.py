"""Parts and gaps of a shape that are thinner than the voxels it is classified in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from ..mesh.model_frame import ModelFrame
from ..mesh.voxels import VoxelGrid
from .source import Source

RESOLVED = 0.2
"""Thickness, in voxels, that the finest cells of stage init still resolve."""
STEPS = (RESOLVED, 0.35, 0.5, 0.7, 1.0)
"""Lengths that are tried, in voxels."""
WORTH_SAYING = 5e-3
"""Share of the surface."""


@dataclass(frozen=True)
class ThinParts:
    """Of samples of a surface; thicknesses in voxels."""

    share: float
    """Share of the surface whose opposite sheet, across the shape or a gap, is within a voxel."""
    too_thin: float
    """Share of it that has the opposite sheet within RESOLVED."""
    lost: float
    """Share of it that has no interior voxel beside it."""

    def warning(self) -> str | None:
        """What the user should know, if anything."""
        said = [
            f"{100 * share:.1f} % of the surface {what}"
            for share, what in (
                (self.too_thin, f"belongs to parts or gaps thinner than {RESOLVED:g} voxels"),
                (self.lost, "has no interior voxel beside it"),
            )
            if share > WORTH_SAYING
        ]
        return " and ".join(said) + " and may be lost: raise -n" if said else None


def thin_parts(source: Source, grid: VoxelGrid, threads: int) -> ThinParts:
    """Of ``source``, classified as ``grid``."""
    frame = ModelFrame(grid.origin, grid.spacing)
    surface = source.true_surface(frame, threads)
    # Where a step to one side ends on the other, a sheet has been crossed.
    thin = np.zeros((len(STEPS), len(surface.samples)), dtype=bool)
    for row, step in zip(thin, STEPS, strict=True):
        row |= ~surface.inside(surface.samples - step * surface.normals)
        row |= surface.inside(surface.samples + step * surface.normals)
    at = np.floor(surface.samples).astype(np.int64)
    at = np.clip(at, 0, np.array(grid.interior.shape) - 1)
    beside = binary_dilation(grid.interior, np.ones((3, 3, 3)))
    return ThinParts(
        share=float(thin.any(axis=0).mean()),
        too_thin=float(thin[0].mean()),
        lost=float((~beside[tuple(at.T)]).mean()),
    )
