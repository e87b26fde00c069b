"""Inner generators, placed so that the surface does not change (paper, appendix C.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..diagram.delaunay import Floats, Ints, in_passing
from ..diagram.interface import VoronoiSurface
from ..diagram.rings import EDGES
from ..diagram.vertices import FLAT

SMALLEST_BATCH = 200
OVERSAMPLING = 3
INNER_ROUNDS = 50
OUTER_ROUNDS = 200
IN_VAIN = 1_000_000
"""Number of candidates in a row that do not fit, after which the search ends."""
BACKTRACKS = 6


@dataclass(frozen=True)
class Guard:
    """The generators of the surface and the spheres at its vertices. Inner generators must lie
    outside of these spheres."""

    generators: Floats
    inside: NDArray[np.bool_]
    centres: Floats
    radii: Floats

    @cached_property
    def within(self) -> Floats:
        """The inside generators of the surface."""
        return self.generators[self.inside]

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.generators)

    @classmethod
    def of(cls, generators: Floats, inside: NDArray[np.bool_], surface: VoronoiSurface) -> Guard:
        """The guard of an interface. The sphere at a vertex passes through its four generators."""
        sound = surface.flatness >= FLAT
        centres = surface.mesh.vertices[sound]
        first = generators[surface.tetrahedra[sound, 0]]
        return cls(generators, inside, centres, np.linalg.norm(centres - first, axis=1))

    @cached_property
    def powers(self) -> tuple[Any, float]:
        """A tree that finds the sphere to which a point has the smallest power, and a squared
        distance.

        The centres have a fourth coordinate, ``sqrt(R^2 - r^2)`` for the largest radius R. With it,
        the nearest centre has the smallest power, and a point is in a sphere if the squared
        distance is below R^2.
        """
        from scipy.spatial import cKDTree

        square = self.radii**2
        most = float(square.max(initial=0.0))
        raised = np.column_stack([self.centres, np.sqrt(np.maximum(most - square, 0))])
        return cKDTree(raised), most

    def admits(self, points: Floats, threads: int) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside the surface and outside every sphere.

        Generators at such points do not change the surface.
        """
        nearest = self.tree.query(points, workers=threads)[1]
        admitted = np.asarray(self.inside[nearest])
        tree, most = self.powers
        flat = np.column_stack([points[admitted], np.zeros(int(admitted.sum()))])
        distance = tree.query(flat, workers=threads)[0]
        admitted[admitted] = distance**2 > most
        return admitted

    def moved(self, points: Floats, step: Floats, threads: int) -> Floats:
        """``points + step (M, 3)``. A step that would end in a sphere or outside is halved.

        After BACKTRACKS halvings the point stays where it is.
        """
        moved = points + step
        left = np.flatnonzero(~self.admits(moved, threads))
        for halving in range(1, BACKTRACKS + 2):
            if len(left) == 0:
                break
            moved[left] = points[left]
            if halving <= BACKTRACKS:
                moved[left] += 0.5**halving * step[left]
                left = left[~self.admits(moved[left], threads)]
        return moved

    def touching_outside(self, points: Floats) -> Ints:
        """The indices of ``points`` whose cell shares a face with an outside
        cell in the full diagram."""
        diagram = in_passing(np.concatenate([points, self.generators]))
        outside = np.concatenate([np.zeros(len(points), bool), ~self.inside])
        ends = diagram.corners[:, EDGES].reshape(-1, 2)
        ends = np.concatenate([ends, ends[:, ::-1]])
        return np.unique(ends[(ends[:, 0] < len(points)) & outside[ends[:, 1]], 0])


def sample(
    guard: Guard,
    count: int,
    random: Callable[[str, int], np.random.Generator],
    threads: int,
    tick: Callable[[int], None],
    places: Callable[[np.random.Generator, int], Floats] | None = None,
    fewer: bool = False,
) -> Floats:
    """``count`` inner generators ``(count, 3)``, verified in the Voronoi diagram (appendix C.2).

    Candidates come in batches from ``places``; the default is uniform in the bounding box. Those in
    a vertex sphere are dropped at once. Of the others, those whose cells touch an outside cell are
    dropped until there are none. If so many do not fit, those that do are returned if ``fewer`` are
    allowed. Otherwise, and if none fits, InputError is raised.
    """
    low, high = guard.within.min(axis=0), guard.within.max(axis=0)
    found, tried = np.zeros((0, 3)), 0
    for round_number in range(OUTER_ROUNDS):
        wanted = max(SMALLEST_BATCH, OVERSAMPLING * (count - len(found)))
        generator = random("candidates", round_number)
        if places is None:
            batch = low + generator.random((wanted, 3)) * (high - low)
        else:
            batch = places(generator, wanted)
        batch = batch[guard.admits(batch, threads)]
        for _ in range(INNER_ROUNDS):
            if len(batch) == 0:
                break
            # Earlier ones need no second check: further generators only make their cells smaller.
            offending = guard.touching_outside(batch)
            if len(offending) == 0:
                break
            batch = np.delete(batch, offending, axis=0)
        tried = 0 if len(batch) else tried + wanted
        found = np.concatenate([found, batch])
        tick(min(len(found), count))
        if len(found) >= count:
            return found[:count]
        if tried > IN_VAIN:
            break
    if fewer and len(found):
        return found
    raise InputError(
        f"only {len(found)} of {count} inner generators fit without touching the surface; "
        "lower --inner or raise -n"
    )
