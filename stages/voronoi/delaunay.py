"""Delaunay tetrahedra of the generators, by one of several backends.

scipy (Qhull) is the default and the reference. Another one is chosen for a run; where it fails,
scipy does that diagram, and it is counted.
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
    """Delaunay tetrahedra: ``corners (T, 4)`` generator indices, ``neighbours (T, 4)``.

    ``neighbours[t, k]`` is the tetrahedron across the facet opposite corner ``k``, -1 on the hull.
    """

    corners: Ints
    neighbours: Ints


Backend = Callable[[Floats], Tetrahedra]
"""The tetrahedra of points ``(N, 3)``, finite and at least five; raises RuntimeError when it cannot
say. Points that are no corner of any are left out."""


def by_scipy(generators: Floats) -> Tetrahedra:
    """Qhull's."""
    from scipy.spatial import Delaunay, QhullError

    try:
        result: Any = Delaunay(generators)
    except QhullError as error:
        raise NumericalFailure(f"Qhull: {str(error).splitlines()[0]}") from error
    return Tetrahedra(result.simplices.astype(np.int64), result.neighbors.astype(np.int64))


def by_shull(generators: Floats) -> Tetrahedra:
    """shull's, computed in a child process. Raises BackendMissing when it is not installed."""
    from .shull_child import tetrahedra

    return Tetrahedra(*tetrahedra(generators))


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
            f"--backend {self.name} failed in {len(self.failures)} of {self.diagrams} diagrams "
            f"({self.failures[0]}); scipy did those"
        )


_USED: ContextVar[Use | None] = ContextVar("backend", default=None)


@contextmanager
def backend(name: str) -> Iterator[Use]:
    """Use the backend ``name`` within the block. Raises BackendMissing if it is not installed."""
    from importlib.util import find_spec

    if name != "scipy" and find_spec(name) is None:
        raise BackendMissing(
            f"--backend {name}: not installed; pip install 'vorolight[fast]', or --backend scipy"
        )
    use = Use(name)
    token = _USED.set(use)
    try:
        yield use
    finally:
        _USED.reset(token)


def delaunay(generators: Floats) -> Tetrahedra:
    """The Delaunay tetrahedra of ``generators (N, 3)``, by the backend in use, in an order of its
    own.

    Raises NumericalFailure for what no backend can be trusted with: fewer than five points, values
    that are not finite, two generators at one place.
    """
    if len(generators) < 5:
        raise NumericalFailure(f"{len(generators)} generators are too few for a Voronoi diagram")
    if not np.isfinite(generators).all():
        raise NumericalFailure("a generator is not finite: the optimisation diverged")
    use = _USED.get() or Use()
    use.diagrams += 1
    result = None
    if use.name != "scipy":
        try:
            result = BACKENDS[use.name](generators)
        except RuntimeError as error:
            use.failures.append(str(error))
    if result is None:
        result = by_scipy(generators)
    present = np.zeros(len(generators), dtype=bool)
    present[result.corners] = True
    # Backends leave out what coincides.
    if not present.all() and len(np.unique(generators, axis=0)) < len(generators):
        raise NumericalFailure("two generators coincide")
    return _in_order(result, len(generators))


def _in_order(found: Tetrahedra, count: int) -> Tetrahedra:
    """Corners ascending and tetrahedra sorted by them, so that all backends give the same bits."""
    place = np.argsort(found.corners, axis=1)
    corners = np.take_along_axis(found.corners, place, axis=1)
    order = np.lexsort((corners[:, 2:] @ [count, 1], corners[:, :2] @ [count, 1]))
    number = np.empty(len(order) + 1, dtype=np.int64)
    number[order], number[-1] = np.arange(len(order)), -1
    neighbours = number[np.take_along_axis(found.neighbours, place, axis=1)]
    return Tetrahedra(corners[order], neighbours[order])
