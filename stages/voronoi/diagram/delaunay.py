"""Delaunay tetrahedra of the generators, by one of several libraries.

scipy (Qhull) is the reference, and every diagram that is written comes from it. Another library may
compute the diagrams within iterations. If it fails, scipy computes that diagram, and the failure is
counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import BackendMissing, NumericalFailure

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tetrahedra:
    """Delaunay tetrahedra. ``corners (T, 4)`` are indices of generators, ascending.

    ``neighbours[t, k]`` is the tetrahedron across the facet opposite corner ``k``, -1 on the convex
    hull.
    """

    corners: Ints
    neighbours: Ints


OVERLAP = 1e-9
"""Tetrahedra overlap if the sum of their volumes exceeds the convex hull's by a larger share."""
PACKED = 2_000_000
"""Number of points below which three indices fit into one key of 64 bits."""

Backend = Callable[[Floats], tuple[Ints, Ints]]
"""A function from at least five finite points ``(N, 3)`` to corners and neighbours, in any order.

It raises RuntimeError if it fails. Points that it leaves out are corners of no tetrahedron.
"""


def by_scipy(generators: Floats) -> tuple[Ints, Ints]:
    """Delaunay tetrahedra by Qhull. Raises NumericalFailure if it fails."""
    from scipy.spatial import Delaunay, QhullError

    try:
        result: Any = Delaunay(generators)
    except QhullError as error:
        raise NumericalFailure(f"Qhull: {str(error).splitlines()[0]}") from error
    return result.simplices.astype(np.int64), result.neighbors.astype(np.int64)


def by_shull(generators: Floats) -> tuple[Ints, Ints]:
    """Delaunay tetrahedra by shull, in a child process.

    Raises RuntimeError if they do not fill the convex hull: on degenerate points, shull 0.4 may
    return tetrahedra that overlap.
    """
    from scipy.spatial import ConvexHull

    from .shull_child import tetrahedra

    corners, neighbours = tetrahedra(generators)
    base = generators[corners[:, 0]]
    a, b, c = (generators[corners[:, k]] - base for k in (1, 2, 3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    whole = ConvexHull(generators).volume
    if abs(np.abs(volume).sum() - whole) > OVERLAP * whole:
        raise RuntimeError("tetrahedra overlap")
    return corners, neighbours


BACKENDS: dict[str, Backend] = {"scipy": by_scipy, "shull": by_shull}


@dataclass
class Use:
    """The library in use, and its failures."""

    name: str = "scipy"
    diagrams: int = 0
    failures: list[str] = field(default_factory=list)
    """The reason of each failure, after which scipy computed the diagram."""

    def warning(self) -> str | None:
        """A warning for the manifest if there were failures."""
        if not self.failures:
            return None
        return (
            f"--backend {self.name} failed in {len(self.failures)} of {self.diagrams} "
            f"diagrams ({self.failures[0]}); scipy computed those instead"
        )


_USED: ContextVar[Use | None] = ContextVar("backend", default=None)


@contextmanager
def backend(name: str) -> Iterator[Use]:
    """Use the library ``name`` within the block. Raises BackendMissing if it is not installed."""
    from importlib.util import find_spec

    if name != "scipy" and find_spec(name) is None:
        raise BackendMissing(
            f"--backend {name}: not installed; run: pip install 'vorolight[fast]', or use "
            "--backend scipy"
        )
    use = Use(name)
    token = _USED.set(use)
    try:
        yield use
    finally:
        _USED.reset(token)


def delaunay(generators: Floats) -> Tetrahedra:
    """The Delaunay tetrahedra of ``generators (N, 3)`` by scipy, in a canonical order.

    Raises NumericalFailure if there are fewer than five generators, if one is not finite, or if two
    coincide.
    """
    return _checked(generators, by_scipy)


def in_passing(generators: Floats) -> Tetrahedra:
    """The same as ``delaunay``, by the library in use.

    It is for diagrams within iterations, which are not written.
    """
    use = _USED.get() or Use()
    use.diagrams += 1
    if use.name != "scipy":
        try:
            return _checked(generators, BACKENDS[use.name])
        except RuntimeError as error:
            use.failures.append(str(error))
    return delaunay(generators)


def _checked(generators: Floats, method: Backend) -> Tetrahedra:
    if len(generators) < 5:
        raise NumericalFailure(
            f"{len(generators)} generators are too few for a Voronoi diagram; raise -n"
        )
    if not np.isfinite(generators).all():
        raise NumericalFailure(
            "a generator is not finite, since the optimisation diverged; lower the learning rate"
        )
    corners, neighbours = method(generators)
    present = np.zeros(len(generators), dtype=bool)
    present[corners] = True
    # Libraries leave out points that coincide with others.
    if not present.all() and len(np.unique(generators, axis=0)) < len(generators):
        raise NumericalFailure(
            "two generators coincide, so there is no face between them; change -n a little"
        )
    return _in_order(corners, neighbours, len(generators))


def _in_order(corners: Ints, neighbours: Ints, count: int) -> Tetrahedra:
    """The tetrahedra in a canonical order, so that all libraries give the same
    result to the last bit."""
    place = np.argsort(corners, axis=1)
    corners = np.take_along_axis(corners, place, axis=1)
    if count < PACKED:
        # At most two tetrahedra have the same first three corners.
        key = (corners[:, 0] * count + corners[:, 1]) * count + corners[:, 2]
        order = np.argsort(key)
        twin = np.flatnonzero(np.diff(key[order]) == 0)
        twin = twin[corners[order[twin], 3] > corners[order[twin + 1], 3]]
        order[twin], order[twin + 1] = order[twin + 1], order[twin]
    else:
        order = np.lexsort(corners.T[::-1])
    number = np.empty(len(order) + 1, dtype=np.int64)
    number[order], number[-1] = np.arange(len(order)), -1
    neighbours = np.take_along_axis(neighbours, place, axis=1)[order]
    return Tetrahedra(corners[order], number[neighbours])
