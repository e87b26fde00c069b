"""The three regularisation losses of the surface (paper, appendix A.2)."""

from __future__ import annotations

import torch

from ...mesh.frames import Connectivity, Frames


def normal_consistency(frames: Frames, connectivity: Connectivity) -> torch.Tensor:
    """``L_normal = mean_f (1 - <n_f, nbar_f>)^2``, where nbar_f is the unit mean of
    the neighbours' normals."""
    mean = connectivity.neighbour_mean(frames.normal)
    mean = mean / (torch.linalg.vector_norm(mean, dim=1, keepdim=True) + 1e-12)
    deviation = 1 - (frames.normal * mean).sum(1)
    return torch.mean(deviation**2)


def area_uniformity(frames: Frames) -> torch.Tensor:
    """``L_area = mean_f (A_f - Abar)^2 / Abar``.

    Its unit is that of an area, so that its weight is meant for model units, in which h0 is 1.
    """
    mean = frames.area.mean()
    return ((frames.area - mean) ** 2).mean() / mean


def centroid_alignment(frames: Frames, connectivity: Connectivity) -> torch.Tensor:
    """``L_fc = mean_f |c_f - cbar_f|^2 / Abar``, where cbar_f is the mean of the
    neighbours' centroids."""
    mean = connectivity.neighbour_mean(frames.centroid)
    return ((frames.centroid - mean) ** 2).sum(1).mean() / frames.area.mean()
