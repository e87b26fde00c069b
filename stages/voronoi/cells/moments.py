"""Volumes, centroids and energies of some cells of a Voronoi diagram.

They are computed cell by cell, without the whole diagram.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import NumericalFailure
from ..diagram.delaunay import Floats, Ints
from .grading import Grid

NEIGHBOURS = 60
"""Number of nearest points that are used at first. Few cells need more."""
SLICE = 20_000
"""Number of cells whose neighbours are in memory at the same time."""
FACES = (128, 1024, 8192)
"""Numbers of planes for which memory is reserved, in turn. Few cells need more than the first."""


@dataclass(frozen=True)
class Moments:
    """Moments of M cells. For the density rho and the generator g of a cell:

    ``mass (M,)`` is the integral of rho, ``centroid (M, 3)`` that of ``rho x`` divided by the mass,
    ``energy (M,)`` that of ``rho |x - g|^2``, and ``volume (M,)`` that of 1.
    """

    mass: Floats
    centroid: Floats
    energy: Floats
    volume: Floats


def cell_moments(
    generators: Floats, count: int, density: Grid | None = None, threads: int = 1
) -> Moments:
    """Moments of the cells of the first ``count`` of ``generators (N, 3)``.

    Without ``density`` the density is 1. Cells are cut out of a box around all generators, so that
    unbounded cells end there. Raises NumericalFailure if a generator is not finite, if two
    coincide, or if a cell has too many faces.
    """
    from scipy.spatial import cKDTree

    if not np.isfinite(generators).all():
        raise NumericalFailure("a generator is not finite: the optimisation diverged")
    tree = cKDTree(generators)
    sums = np.zeros((count, 6))
    slices = np.array_split(np.arange(count), max(threads, -(-count // SLICE)))
    with ThreadPoolExecutor(threads) as pool:
        for part, found in zip(
            slices,
            pool.map(lambda part: _sums(tree, generators, part, density), slices),
            strict=True,
        ):
            sums[part] = found
    mass = sums[:, 0]
    safe = np.where(mass > 0, mass, 1.0)
    centroid = generators[:count] + sums[:, 1:4] / safe[:, None]
    return Moments(mass, centroid, sums[:, 4], sums[:, 5])


def _sums(tree: Any, generators: Floats, cells: Ints, density: Grid | None) -> Floats:
    """The result of ``clipping.cell_sums``, with as many neighbours for each cell as it needs."""
    from . import clipping

    edge = np.ptp(generators, axis=0).max()
    low, high = generators.min(axis=0) - edge, generators.max(axis=0) + edge
    nodes = (
        (np.zeros((0, 0, 0)), np.zeros(3), 1.0)
        if density is None
        else (density.values, density.origin, density.spacing)
    )
    sums = np.zeros((len(cells), 6))
    left, neighbours, room = np.arange(len(cells)), NEIGHBOURS, 0
    while len(left):
        wanted = min(neighbours + 1, len(generators))
        distance, around = tree.query(generators[cells[left]], k=wanted)
        if (distance[:, 1] == 0).any():
            raise NumericalFailure(
                "two generators coincide, so there is no face between them; change --inner a little"
            )
        status = np.zeros(len(left), dtype=np.int64)
        found = np.zeros((len(left), 6))
        clipping.cell_sums(
            generators, cells[left], around[:, 1:], low, high, *nodes, FACES[room], found, status
        )
        if (status == clipping.CROWDED).any():
            room += 1
            if room == len(FACES):
                raise NumericalFailure(
                    f"an inner cell has more than {FACES[-1]} faces; raise --inner, or lower "
                    "--spacing"
                )
        if (status == clipping.INCOMPLETE).any():
            neighbours *= 4
        sums[left[status == 0]] = found[status == 0]
        left = left[status != 0]
    return sums
