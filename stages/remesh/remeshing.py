"""Isotropic remeshing of closed triangle surfaces that keeps to a true surface and its creases."""

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
"""Share of the way that a vertex goes at once towards the middle of its triangles."""
LONGEST_MOVE = 0.3
"""Of a vertex at once, in target lengths."""
DIVISIONS = 60
"""The most rounds in which the edges of an input are halved."""
FEW = 0.02
"""Share of the triangles that have to vanish in a sweep for another sweep of thinning out."""
LAST, LAST_STEP = 3, 0.2
"""The last iterations, and that share in them: creases come to rest."""
EMBEDDED = 4
"""Iterations before the creases are looked for among the edges of a new surface."""
FITS = 3
"""Fits at the end."""
SHARP = 0.866
"""Cosine of the normals of two triangles below which their edge is a crease."""
WORSE = 0.01
"""By how much, in target lengths, a flip may take the middle of an edge off the surface."""
OFF, BETTER = 0.03, 0.6
"""An edge whose middle is off by more than this is flipped if that leaves this share of it."""
ASTRAY = 0.3
"""Distance of a folded triangle to its own sheet, in target lengths, from which on there is none
and the fold is an accident."""


def remesh(
    mesh: Sized, length: Length, surface: NearSurface, creases: Creases | None = None,
    iterations: int = 12, embedded: int = EMBEDDED,
) -> int:  # fmt: skip
    """Triangulate the same closed surface with edges about ``length(points)`` long, fitted to
    ``surface``, from iteration ``embedded`` on with edges along its ``creases``. Returns how many
    of those have none.

    Raises ValueError when the surface is not closed and manifold along its edges.
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
    """Contract edges to one of their ends until few are much shorter than their target, so that
    what follows takes time for the triangles that there are to be, not for those of the input."""
    mesh.length = length(mesh.vertices)
    count = np.inf
    while len(mesh.triangles) < (1 - FEW) * count:
        count = len(mesh.triangles)
        everywhere = np.ones(len(mesh.vertices), dtype=bool)
        embedded(lambda trial, at: contract_short(trial, where=at, to_ends=True), mesh, everywhere)


def divide(mesh: Sized, length: Length, surface: NearSurface) -> None:
    """Halve edges until none is longer than its target, with flips in between: long triangles of an
    input would else become many thin ones. Every vertex stays where it is."""
    mesh.length = length(mesh.vertices)
    gain = smooth_only(keeping(surface, delaunay_gain))
    for _ in range(DIVISIONS):
        flip(mesh, gain, 2)
        if not split_long(mesh, passes=1):
            break
        mesh.length = length(mesh.vertices)


def relax(mesh: Sized, step: float, where: NDArray[np.bool_] | None = None) -> None:
    """Move vertices, or those ``where (V,)``, along the surface towards the mean of their
    triangles' centroids, ``step`` of the way. Triangles weigh by their area over the squared target
    length."""
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
        # Along a crease, to the middle of the two neighbours on it.
        both = np.concatenate([mesh.creases[:, :2], mesh.creases[:, 1::-1]])
        for k in range(3):
            total = np.bincount(both[:, 0], mesh.vertices[both[:, 1], k], minlength=count)
            move[on, k] = 0.5 * total[on] - mesh.vertices[on, k]
    move[mesh.rank == CORNER] = 0.0
    if where is not None:
        move[~where] = 0.0
    mesh.vertices = mesh.vertices + limited(step * move, LONGEST_MOVE * mesh.length)


def smooth_only(gain: Gain) -> Gain:
    """``gain`` where an edge is no crease."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        return np.where(fold_cosines(mesh, table)[0] < SHARP, -1.0, gain(mesh, table))

    return value


def keeping(surface: NearSurface, gain: Gain) -> Gain:
    """``gain`` where a flip does not take the edge off the true surface."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        found = gain(mesh, table)
        row = np.flatnonzero(found > 0)
        now, then = _middles(mesh, table, row, surface)
        found[row[then - now > WORSE * mesh.edge_target(table.ends[row])]] = -1.0
        return found

    return value


def nearer_gain(surface: NearSurface) -> Gain:
    """By how much a flip of an edge, at a crease before or after, brings it to the true surface."""

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
    """Distances of the middles of edges ``row`` to the true surface, now and after their flip."""
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
    """Triangles ``(T,)`` at a folded edge that the true surface does not have."""
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
    """Undo folds that the true surface does not have: by flips, then by moving the vertices to the
    mean of their neighbours, where no triangles cross then."""
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
