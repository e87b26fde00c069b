"""Isotropic remeshing of closed triangle surfaces that follows a true surface and its creases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.creases import CORNER, CREASE, FREE, Creases, cut_ears, drawn_on, embed, give_up_flat
from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import limited, triangle_normals, vertex_normals
from ..mesh.polygons import Floats, Ints
from .embedding import embedded, kept_embedded
from .fitting import fit
from .operations import (
    FOLDED,
    Gain,
    contract_short,
    delaunay_gain,
    flip,
    fold_cosines,
    split_long,
    unfolding_gain,
    valence_gain,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..mesh.queries.true_surface import NearSurface

    Length = Callable[[Floats], Floats]

STEP = 0.7
"""Share of the distance to the mean of its triangles that a vertex moves in one iteration."""
LONGEST_MOVE = 0.3
"""Largest move of a vertex in one iteration, in target lengths."""
DIVISIONS = 60
"""Largest number of rounds in which the edges of an input are halved."""
FEW = 0.02
"""Thinning out ends when a sweep removes a smaller share of the triangles."""
LAST, LAST_STEP = 3, 0.2
"""Number of last iterations, and their value of STEP. Creases come to rest in them."""
EMBEDDED = 4
"""Number of iterations before creases are embedded into the edges of a new surface."""
FITS = 3
"""Number of fits at the end."""
SHARP = 0.866
"""An edge is a crease if the cosine of the normals of its two triangles is less."""
WORSE = 0.01
"""Largest distance, in target lengths, by which a flip may move the middle of an edge
away from the surface."""
OFF, BETTER = 0.03, 0.6
"""An edge is flipped if its middle is further from the surface than the first number, in target
lengths, and if the flip multiplies the distance by less than the second."""
ASTRAY = 0.3
"""Distance of a folded triangle from the true surface, in target lengths, above which the fold is
not one of the surface."""


def remesh(
    mesh: Sized, length: Length, surface: NearSurface, creases: Creases | None = None,
    iterations: int = 12, embedded: int = EMBEDDED,
) -> int:  # fmt: skip
    """Remesh a closed surface with edges of about ``length(points)``, fitted to ``surface``.

    From iteration ``embedded`` on, edges follow the ``creases``. Returns the number of creases that
    no edges follow. Raises ValueError unless every edge of the surface is in two triangles.
    """
    mesh.length, missed = length(mesh.vertices), 0
    nearer, valence, delaunay = (
        nearer_gain(surface), smooth_only(valence_gain), keeping(surface, delaunay_gain)
    )  # fmt: skip
    for iteration in range(iterations):
        if creases is not None and iteration == embedded:
            missed = embed(mesh, creases)
        cut_ears(mesh)
        split_long(mesh)
        contract_short(mesh)
        flip(mesh, valence if mesh.metric is None else delaunay)
        flip(mesh, nearer, 2)
        before = mesh.vertices
        relax(mesh, STEP if iteration < iterations - LAST else LAST_STEP)
        fit(mesh, surface)
        if creases is not None:
            drawn_on(mesh, creases)
        mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)
        unfold(mesh, surface)
        mesh.length = length(mesh.vertices)
    cut_ears(mesh)
    contract_short(mesh)
    flip(mesh, smooth_only(delaunay_gain))
    flip(mesh, nearer, 2)
    give_up_flat(mesh)
    before = mesh.vertices
    for _ in range(FITS):
        fit(mesh, surface)
    mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)
    flip(mesh, delaunay)
    unfold(mesh, surface)
    before = mesh.vertices
    fit(mesh, surface)
    if creases is not None:
        drawn_on(mesh, creases)
    mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)
    return missed


def thin_out(mesh: Sized, length: Length) -> None:
    """Contract edges to one of their ends until few are much shorter than their target length.

    The time of what follows then depends on the number of triangles of the result, not of the
    input.
    """
    mesh.length = length(mesh.vertices)
    count = np.inf
    while len(mesh.triangles) < (1 - FEW) * count:
        count = len(mesh.triangles)
        everywhere = np.ones(len(mesh.vertices), dtype=bool)
        embedded(lambda trial, at: contract_short(trial, where=at, to_ends=True), mesh, everywhere)


def divide(mesh: Sized, length: Length, surface: NearSurface) -> None:
    """Halve edges until none is longer than its target length. Every vertex keeps its place.

    Edges are flipped in between. Otherwise long triangles of an input would become many thin ones.
    """
    mesh.length = length(mesh.vertices)
    gain = smooth_only(keeping(surface, delaunay_gain))
    for _ in range(DIVISIONS):
        flip(mesh, gain, 2)
        if not split_long(mesh, passes=1):
            break
        mesh.length = length(mesh.vertices)


def relax(mesh: Sized, step: float, where: NDArray[np.bool_] | None = None) -> None:
    """Move vertices along the surface towards the mean of their triangles' centroids.

    They move ``step`` times the distance; only vertices ``where (V,)`` do, by default all. The
    weight of a triangle is its area divided by the squared target length.
    """
    _, area = triangle_normals(mesh.vertices, mesh.triangles)
    weight = area / mesh.length[mesh.triangles].mean(axis=1) ** 2
    centroid = weight[:, None] * mesh.vertices[mesh.triangles].mean(axis=1)
    flat, count = mesh.triangles.reshape(-1), len(mesh.vertices)
    total = np.bincount(flat, np.repeat(weight, 3), minlength=count)
    sums = [np.bincount(flat, np.repeat(centroid[:, k], 3), minlength=count) for k in range(3)]
    mean = np.stack(sums, 1) / np.maximum(total, np.finfo(float).tiny)[:, None]
    normal = vertex_normals(mesh.vertices, mesh.triangles)
    move = mean - mesh.vertices
    move -= np.einsum("ij,ij->i", move, normal)[:, None] * normal
    on = np.flatnonzero(mesh.rank == CREASE)
    if len(on):
        # Vertices on a crease move to the middle between their two neighbours on it.
        both = np.concatenate([mesh.creases[:, :2], mesh.creases[:, 1::-1]])
        for k in range(3):
            total = np.bincount(both[:, 0], mesh.vertices[both[:, 1], k], minlength=count)
            move[on, k] = 0.5 * total[on] - mesh.vertices[on, k]
    move[mesh.rank == CORNER] = 0.0
    if where is not None:
        move[~where] = 0.0
    mesh.vertices = mesh.vertices + limited(step * move, LONGEST_MOVE * mesh.length)


def smooth_only(gain: Gain) -> Gain:
    """``gain`` for edges that are not creases."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        return np.where(fold_cosines(mesh, table)[0] < SHARP, -1.0, gain(mesh, table))

    return value


def keeping(surface: NearSurface, gain: Gain) -> Gain:
    """``gain`` for flips that do not move an edge away from the true surface."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        found = gain(mesh, table)
        row = np.flatnonzero(found > 0)
        now, then = _middles(mesh, table, row, surface)
        found[row[then - now > WORSE * mesh.edge_target(table.ends[row])]] = -1.0
        return found

    return value


def nearer_gain(surface: NearSurface) -> Gain:
    """The decrease of an edge's distance to the true surface by its flip.

    It is positive only for edges that are creases before or after the flip.
    """

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        found = np.full(len(table.ends), -1.0)
        row = np.flatnonzero(np.minimum(*fold_cosines(mesh, table)) < SHARP)
        target = mesh.edge_target(table.ends[row])
        now, then = (d / target for d in _middles(mesh, table, row, surface))
        found[row] = np.where((now > OFF) & (then < BETTER * now), now - then, -1.0)
        return found

    return value


def _middles(
    mesh: Sized, table: EdgeTable, row: Ints, surface: NearSurface
) -> tuple[Floats, Floats]:
    """Distances of the middles of edges ``row`` to the true surface, before
    and after their flip."""
    if len(row) == 0:
        return np.zeros(0), np.zeros(0)
    normal, _ = triangle_normals(mesh.vertices, mesh.triangles)
    facing = normal[table.triangles[row]].sum(axis=1)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), np.finfo(float).tiny)
    at = np.concatenate(
        [mesh.vertices[ends[row]].mean(axis=1) for ends in (table.ends, table.opposite)]
    )
    foot, _ = surface.closest(at, np.concatenate([facing, facing]))
    distance = np.linalg.norm(at - foot, axis=1)
    return distance[: len(row)], distance[len(row) :]


def astray(mesh: Sized, surface: NearSurface) -> NDArray[np.bool_]:
    """The triangles ``(T,)`` at folded edges where the true surface has no fold."""
    table = EdgeTable.of(mesh.triangles)
    found = np.zeros(len(mesh.triangles), dtype=bool)
    folded = np.unique(table.triangles[fold_cosines(mesh, table)[0] < FOLDED])
    if len(folded):
        normal, _ = triangle_normals(mesh.vertices, mesh.triangles[folded])
        at = mesh.vertices[mesh.triangles[folded]].mean(axis=1)
        foot, outward = surface.closest(at, normal)
        target = mesh.length[mesh.triangles[folded]].mean(axis=1)
        wrong = np.linalg.norm(at - foot, axis=1) > ASTRAY * target
        found[folded] = wrong | (np.einsum("ij,ij->i", outward, normal) < FOLDED)
    return found


def unfold(mesh: Sized, surface: NearSurface, rounds: int = 5) -> None:
    """Remove folds that the true surface does not have.

    Edges are flipped first. Then vertices move to the mean of their neighbours, unless triangles
    would newly cross.
    """
    for _ in range(rounds):
        flip(mesh, unfolding_gain, 2)
        wrong = astray(mesh, surface)
        if not wrong.any():
            return
        mean = EdgeTable.of(mesh.triangles).mean_of_neighbours(mesh.vertices)
        moved = np.unique(mesh.triangles[wrong])
        moved = moved[mesh.rank[moved] == FREE]
        after = mesh.vertices.copy()
        after[moved] = mean[moved]
        mesh.vertices = kept_embedded(mesh.vertices, after, mesh.triangles)
