"""Generators deep inside, placed so that the surface stays as it is (paper's appendix C.2)."""

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
"""Candidates in a row of which none fits, after which there is no room."""
BACKTRACKS = 6


@dataclass(frozen=True)
class Guard:
    """The surface's generators and vertex spheres, which inner generators must keep out of."""

    generators: Floats
    inside: NDArray[np.bool_]
    centres: Floats
    radii: Floats

    @cached_property
    def within(self) -> Floats:
        """The inside generators."""
        return self.generators[self.inside]

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.generators)

    @classmethod
    def of(cls, generators: Floats, inside: NDArray[np.bool_], surface: VoronoiSurface) -> Guard:
        """From a raw interface: each vertex with the sphere through its four generators."""
        sound = surface.flatness >= FLAT
        centres = surface.mesh.vertices[sound]
        first = generators[surface.tetrahedra[sound, 0]]
        return cls(generators, inside, centres, np.linalg.norm(centres - first, axis=1))

    @cached_property
    def powers(self) -> tuple[Any, float]:
        """A tree over the spheres, and the square of a distance: a point is in one of them if it is
        nearer than that. In a fourth dimension centres are raised by what radii are smaller than
        the largest, so that the nearest one is that of the smallest power."""
        from scipy.spatial import cKDTree

        square = self.radii**2
        most = float(square.max(initial=0.0))
        raised = np.column_stack([self.centres, np.sqrt(np.maximum(most - square, 0))])
        return cKDTree(raised), most

    def admits(self, points: Floats, threads: int) -> NDArray[np.bool_]:
        """Points inside the surface and outside every vertex sphere; they change no face."""
        nearest = self.tree.query(points, workers=threads)[1]
        admitted = np.asarray(self.inside[nearest])
        tree, most = self.powers
        flat = np.column_stack([points[admitted], np.zeros(int(admitted.sum()))])
        distance = tree.query(flat, workers=threads)[0]
        admitted[admitted] = distance**2 > most
        return admitted

    def moved(self, points: Floats, step: Floats, threads: int) -> Floats:
        """``points + step (M, 3)``; a step that would end in a vertex sphere or outside is halved,
        and given up after a few halvings."""
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
        """Indices of ``points`` whose cell has a face with an outside cell in the full diagram."""
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
) -> Floats:
    """``count`` verified interior generators ``(count, 3)`` (the paper's appendix C.2).

    Batches of candidates from ``places``, by default uniform in the bounding box; those in a vertex
    sphere go at once, the rest are verified in the Voronoi diagram until none touches an outside
    cell. Raises InputError when they do not fit.
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
            # Those found before need no second look: a cell only shrinks as others come.
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
    raise InputError(
        f"only {len(found)} of {count} inner generators fit without touching the surface; "
        "lower --inner or raise -n"
    )
