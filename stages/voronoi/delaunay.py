"""Delaunay tetrahedra of the generators: scipy (Qhull) is the reference backend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tetrahedra:
    """Delaunay tetrahedra: ``corners (T, 4)`` generator indices, ``neighbours (T, 4)``.

    ``neighbours[t, k]`` is the tetrahedron across the facet opposite corner ``k``, -1 on the hull.
    """

    corners: Ints
    neighbours: Ints


def delaunay(generators: Floats) -> Tetrahedra:
    """The Delaunay tetrahedra of ``generators (N, 3)``.

    Raises NumericalFailure for what Qhull cannot be trusted with: fewer than five points, values
    that are not finite, two generators at one place.
    """
    from scipy.spatial import Delaunay, QhullError

    if len(generators) < 5:
        raise NumericalFailure(f"{len(generators)} generators are too few for a Voronoi diagram")
    if not np.isfinite(generators).all():
        raise NumericalFailure("a generator is not finite: the optimisation diverged")
    if len(np.unique(generators, axis=0)) < len(generators):
        raise NumericalFailure("two generators coincide")
    try:
        result = Delaunay(generators)
    except QhullError as error:
        raise NumericalFailure(f"Qhull: {str(error).splitlines()[0]}") from error
    return Tetrahedra(result.simplices.astype(np.int64), result.neighbors.astype(np.int64))
