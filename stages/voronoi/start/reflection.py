"""The first generators of the paper, by reflection at the boundary (appendix C.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mesh.voxels import VoxelGrid
from ..diagram.delaunay import Floats
from ..diagram.interface import interface

SMOOTHING = 1.5
"""Standard deviation of the Gaussian that smooths the distance before its gradient, in voxels."""


def signed_distance(interior: NDArray[np.bool_]) -> Floats:
    """Euclidean distance to the interior voxels' faces, in voxels, positive outside."""
    from scipy.ndimage import distance_transform_edt

    outside = distance_transform_edt(~interior)
    within = distance_transform_edt(interior)
    return np.asarray(np.where(interior, 0.5 - within, outside - 0.5))


def reflect(grid: VoxelGrid) -> tuple[Floats, NDArray[np.bool_]]:
    """The first generators ``(N, 3)`` of the paper, and whether each is inside, ``(N,)``.

    Outside generators ``g_ext`` are voxel centres of the exterior band. Inside generators are their
    mirror images ``g_ext - 2 delta n(g_ext)`` that fall into interior voxels (equation 1).
    Generators whose cells do not touch a cell of the other label are left out, since they do not
    change the surface. The paper leaves out the inside ones only; but outside ones stay on a
    lattice, which is the slowest input for a Delaunay code. Raises InputError if no generator falls
    inside.
    """
    from scipy.ndimage import gaussian_filter

    distance = signed_distance(grid.interior)
    gradient = np.stack(np.gradient(gaussian_filter(distance, SMOOTHING)), axis=-1)
    index = np.argwhere(grid.exterior)
    at = tuple(index.T)
    normal = gradient[at] / (np.linalg.norm(gradient[at], axis=1, keepdims=True) + 1e-8)
    outside = grid.centres(index)
    mirrored = outside - 2 * grid.spacing * np.abs(distance[at])[:, None] * normal
    voxel = np.floor((mirrored - grid.origin) / grid.spacing).astype(np.int64)
    within = ((voxel >= 0) & (voxel < grid.interior.shape)).all(axis=1)
    within[within] = grid.interior[tuple(voxel[within].T)]
    inside = np.unique(mirrored[within], axis=0)
    if len(inside) == 0:
        raise InputError("no generator falls inside the shape at this resolution; raise -n")
    generators = np.concatenate([inside, outside])
    labels = np.arange(len(generators)) < len(inside)
    touching = np.unique(interface(generators, labels).generators)
    return generators[touching], labels[touching]
