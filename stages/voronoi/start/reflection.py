"""Boundary reflection: where the first generators go (paper's appendix C.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mesh.voxels import VoxelGrid
from ..diagram.delaunay import Floats
from ..diagram.interface import interface

SMOOTHING = 1.5
"""Sigma of the Gaussian that smooths the distance before normals are taken, in voxels."""


def signed_distance(interior: NDArray[np.bool_]) -> Floats:
    """Euclidean distance to the faces of the interior voxels, in voxels, positive outside."""
    from scipy.ndimage import distance_transform_edt

    outside = distance_transform_edt(~interior)
    within = distance_transform_edt(interior)
    return np.asarray(np.where(interior, 0.5 - within, outside - 0.5))


def reflect(grid: VoxelGrid) -> tuple[Floats, NDArray[np.bool_]]:
    """Generators ``(N, 3)`` and which are inside: voxel centres of the exterior band, and their
    mirror images ``g_ext - 2 delta n(g_ext)`` that fall into interior voxels.

    Generators of either label whose cell does not touch one of the other label are left out: they
    do not change the surface (the paper drops the interior ones only), and the lattice they would
    stay on is the slowest input a Delaunay code can get.

    Raises InputError when no generator falls inside.
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
