"""Delaunay tetrahedra of the generators, by one of several backends.

scipy (Qhull) is the reference: what is written comes from it. Another one may be chosen for the
diagrams within iterations; where it fails, scipy does that diagram, and it is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BackendMissing, NumericalFailure

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tetrahedra:
    """Delaunay tetrahedra: ``corners (T, 4)`` generator indices, ascending; ``neighbours (T, 4)``.

    ``neighbours[t, k]`` is the tetrahedron across the facet opposite corner ``k``, -1 on the hull.
    """

    corners: Ints
    neighbours: Ints


OVERLAP = 1e-9
"""Part of the hull's volume that tetrahedra may be counted too much: rounding is far below."""
PACKED = 2_000_000
"""Points below which three indices fit into one 64-bit key."""

Backend = Callable[[Floats], tuple[Ints, Ints]]
"""Corners and neighbours of points ``(N, 3)``, finite and at least five, in whatever order; raises
RuntimeError when it cannot say. Points that are no corner of any are left out."""


def by_scipy(generators: Floats) -> tuple[Ints, Ints]:
    """Qhull's."""
    from scipy.spatial import Delaunay, QhullError

    try:
        result: Any = Delaunay(generators)
    except QhullError as error:
        raise NumericalFailure(f"Qhull: {str(error).splitlines()[0]}") from error
    return result.simplices.astype(np.int64), result.neighbors.astype(np.int64)


def by_shull(generators: Floats) -> tuple[Ints, Ints]:
    """shull's, computed in a child process. Raises RuntimeError when they do not fill the convex
    hull: on degenerate points shull 0.4 may leave some overlapping."""
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
    """A backend in use, and how it went."""

    name: str = "scipy"
    diagrams: int = 0
    failures: list[str] = field(default_factory=list)
    """What it said of each diagram that scipy did in its place."""

    def warning(self) -> str | None:
        """What the manifest says of the failures."""
        if not self.failures:
            return None
        return (
            f"--backend {self.name} failed in {len(self.failures)} of {self.diagrams} "
            f"diagrams ({self.failures[0]}); scipy computed those instead"
        )


_USED: ContextVar[Use | None] = ContextVar("backend", default=None)


@contextmanager
def backend(name: str) -> Iterator[Use]:
    """Use the backend ``name`` within the block. Raises BackendMissing if it is not installed."""
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
    """The Delaunay tetrahedra of ``generators (N, 3)`` by scipy, in an order of their own.

    Raises NumericalFailure for what Qhull cannot be trusted with: fewer than five points, values
    that are not finite, two generators at one place.
    """
    return _checked(generators, by_scipy)


def in_passing(generators: Floats) -> Tetrahedra:
    """As ``delaunay``, by the backend in use: for what is computed many times and not written."""
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
    # Backends leave out what coincides.
    if not present.all() and len(np.unique(generators, axis=0)) < len(generators):
        raise NumericalFailure(
            "two generators coincide, so there is no face between them; change -n a little"
        )
    return _in_order(corners, neighbours, len(generators))


def _in_order(corners: Ints, neighbours: Ints, count: int) -> Tetrahedra:
    """Corners ascending and tetrahedra sorted by them, so that all backends give the same bits."""
    place = np.argsort(corners, axis=1)
    corners = np.take_along_axis(corners, place, axis=1)
    if count < PACKED:
        # Two tetrahedra at the most share their first three corners.
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
