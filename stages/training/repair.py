"""Repair of triangles whose spheres contain generators of other faces.

Edges are contracted and flipped, the surface is made rounder, and it is pulled less to the true
surface. ``divided`` makes triangles smaller where the refinement asks for it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.creases import drawn_on, give_up
from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.polygons import Floats
from ..mesh.queries.intersections import self_intersections
from ..remesh.embedding import embedded, kept_embedded
from ..remesh.fitting import fit
from ..remesh.length_field import GRADATION
from ..remesh.operations import Gain, contract_short, delaunay_gain, flip, split_long
from ..remesh.remeshing import astray, keeping, relax, unfold
from ..remesh.sheets import draw_back, part, smooth
from .spheres import FIRST_RADIUS, Spheres, edge_lengths, intrusion_gain, rings_around

if TYPE_CHECKING:
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface

PATIENCE = 2
"""Number of rounds in which edges are only contracted and flipped. After them, the pull to the
true surface is reduced."""
RELEASE, LOOSEST = 0.3, 0.003
"""Factor of the shape's weight around an intruder in each later round, and its smallest value."""
SETTLED = (0.55, 0.9)
"""Radii around an intruder are limited to this range, in edge lengths."""
RINGS = 3
"""Number of rings of vertices around an intruder that move in a round."""
SHORT = 0.5
"""Shorter edges around an intruder, in edge lengths, are contracted."""
FINEST = 0.05
"""Smallest target length where the surface is made round, in units of h0."""
ROUNDINGS = 2
"""Number of times that the surface is smoothed, parted and remeshed in a round."""
PASSES, STEP = 4, 0.3
"""Number of passes that divide, flip and fit, and the share of the distance to the mean of its
triangles that a vertex moves in each."""
DIVIDED = 1.1
"""Edges longer than this, in target lengths, are halved."""
CONTRACTED = 0.6
"""Edges shorter than this, in target lengths, are contracted."""
CHANGED = 0.999
"""A vertex changes if its target length is below this share of its present length."""


def mended(
    spheres: Spheres, intruded: NDArray[np.bool_], surface: TrueSurface
) -> tuple[Spheres, NDArray[np.bool_]]:
    """The spheres with better triangles around intruders, and which vertices may move, ``(V,)``.

    In the first rounds, short edges are contracted and others flipped. If intruders remain, the
    pull to the true surface is reduced. After that, creases there are removed and the surface is
    made round.
    """
    triangles = spheres.triangles
    wrong = intruded.copy()
    wrong[triangles[astray(spheres.as_mesh(), surface)]] = True
    near = rings_around(triangles, wrong, 1)
    age = spheres.age + near
    old, oldest = (wrong & (age > patience) for patience in (PATIENCE, 2 * PATIENCE))
    loose = rings_around(triangles, old, 1) | rings_around(triangles, oldest, 2)
    less = np.minimum(spheres.hold, np.maximum(RELEASE * spheres.hold, LOOSEST))
    mesh = replace(spheres, hold=np.where(loose, less, spheres.hold), age=age).as_mesh()
    give_up(mesh, np.flatnonzero(rings_around(triangles, oldest, 1)))
    free = rings_around(triangles, wrong, RINGS) | rings_around(triangles, old, 2 * RINGS)
    mesh.carried = np.concatenate([mesh.carried, near[:, None], free[:, None]], axis=1)
    if old.any():
        loose = rings_around(triangles, old, RINGS)
        if len(self_intersections(mesh.vertices, triangles)):
            draw_back(mesh, loose)
        part(mesh, loose)
    if oldest.any():
        finer = rounded(mesh, oldest)
        mesh.carried[finer, -2:] = 1
    _contract(mesh, SHORT, mesh.carried[:, -2] > 0)
    unfold(mesh, surface)
    near, free = (mesh.carried[:, -2:] > 0).T
    _flip(mesh, keeping(surface, intrusion_gain), near)
    mesh.length = np.where(near, edge_lengths(mesh.vertices, mesh.triangles), mesh.length)
    low, high = (limit * mesh.length for limit in SETTLED)
    radii = mesh.carried[:, 0]
    mesh.carried[:, 0] = np.where(near, np.clip(radii, low, high), radii)
    return Spheres.of_mesh(mesh), free


def rounded(mesh: Sized, where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Make the surface at ``where (V,)`` round, and as thick as its edges are long.

    Places that are too sharp or too thin for spheres become blunt. Triangles become even, also
    around these places if they are larger than GRADATION allows. The topology is kept. Returns
    which vertices have new target lengths, ``(V,)``.
    """
    table, own = EdgeTable.of(mesh.triangles), mesh.length
    length, longest = edge_lengths(mesh.vertices, mesh.triangles), own.copy()
    np.maximum.at(longest, table.ends, table.lengths(mesh.vertices)[:, None])
    for _ in range(2):
        least = length.copy()
        for here, there in (table.ends.T, table.ends[:, ::-1].T):
            np.minimum.at(least, here, length[there])
        length = least
    # Elsewhere the target length is that of the longest edge, so that no edge is split, unless
    # shorter edges are close: a large triangle beside small ones would have intruders.
    present = np.where(where, np.inf, longest)
    wanted = np.where(where, np.maximum(length, FINEST), longest)
    mesh.length = graded_down(mesh.vertices, table, present, wanted)
    finer = mesh.length < CHANGED * present
    marks = np.stack([where, finer, own], axis=1)
    mesh.carried = np.concatenate([mesh.carried, marks], axis=1)
    for _ in range(ROUNDINGS):
        where = mesh.carried[:, -3] > 0
        smooth(mesh, where)
        part(mesh, where)
        split_long(mesh)
        _contract(mesh, CONTRACTED, mesh.carried[:, -2] > 0)
        _flip(mesh, delaunay_gain, mesh.carried[:, -2] > 0)
    finer, own = mesh.carried[:, -2] > 0, mesh.carried[:, -1]
    mesh.length = np.where(finer, mesh.length, own)
    mesh.carried = mesh.carried[:, :-3]
    return np.asarray(finer)


def _contract(mesh: Sized, factor: float, where: NDArray[np.bool_]) -> None:
    embedded(lambda trial, at: contract_short(trial, factor, at), mesh, where)


def _flip(mesh: Sized, gain: Gain, where: NDArray[np.bool_]) -> None:
    embedded(lambda trial, at: flip(trial, within(at, gain)), mesh, where)


def within(where: NDArray[np.bool_], gain: Gain) -> Gain:
    """``gain`` for edges whose two triangles have all corners in ``where (V,)``."""

    def value(mesh: Sized, table: EdgeTable) -> Floats:
        inside = where[table.ends].all(axis=1) & where[table.opposite].all(axis=1)
        return np.where(inside, gain(mesh, table), -1.0)

    return value


def graded_down(vertices: Floats, table: EdgeTable, present: Floats, wanted: Floats) -> Floats:
    """``wanted (V,)`` lengths, made shorter around those that are below the ``present`` ones.

    Lengths then grow by at most GRADATION.
    """
    wanted = wanted.copy()
    (a, b), rise = table.ends.T, GRADATION * table.lengths(vertices)
    while True:
        before = wanted.copy()
        # Only vertices whose length changes have an effect on others.
        source = np.where(wanted < CHANGED * present, wanted, np.inf)
        np.minimum.at(wanted, a, source[b] + rise)
        np.minimum.at(wanted, b, source[a] + rise)
        if (wanted > CHANGED * before).all():
            return before


def divided(
    spheres: Spheres, wanted: Floats, surface: TrueSurface, creases: Creases | None, room: float
) -> tuple[Spheres, NDArray[np.bool_]]:
    """The spheres with the ``wanted`` lengths ``(V,)``, and which of them are to be trained,
    ``(V,)``.

    At most ``room`` triangles are added.
    """
    mesh = spheres.as_mesh()
    changed = wanted < CHANGED * spheres.lengths
    free = rings_around(spheres.triangles, changed, RINGS)
    table = EdgeTable.of(spheres.triangles)
    # Elsewhere the target length is that of the longest edge, so that no edge is split.
    longest = np.zeros(len(wanted))
    np.maximum.at(longest, table.ends, table.lengths(spheres.centres)[:, None])
    mesh.length = np.where(changed, wanted, np.maximum(longest, spheres.lengths))
    marks = np.stack([changed, free], axis=1).astype(np.float64)
    mesh.carried = np.concatenate([mesh.carried, marks], axis=1)
    for _ in range(PASSES):
        # Each split adds two triangles.
        room -= 2 * split_long(mesh, DIVIDED, room // 2)
        contract_short(mesh, CONTRACTED, mesh.carried[:, -2] > 0)
        free = mesh.carried[:, -1] > 0
        flip(mesh, within(free, keeping(surface, delaunay_gain)))
        before = mesh.vertices
        relax(mesh, STEP, free)
        # Where the pull to the true surface was reduced, nothing is fitted to it.
        fit(mesh, surface, free & (mesh.carried[:, 1] == 1))
        if creases is not None:
            drawn_on(mesh, creases)
        mesh.vertices = kept_embedded(before, mesh.vertices, mesh.triangles)
    unfold(mesh, surface)
    changed, free = (mesh.carried[:, -2:] > 0).T
    near = rings_around(mesh.triangles, changed, 1)
    now = edge_lengths(mesh.vertices, mesh.triangles)
    mesh.length = np.where(near, now, np.minimum(mesh.length, now))
    result = Spheres.of_mesh(mesh)
    radii = np.where(near, FIRST_RADIUS * result.lengths, result.radii)
    return replace(result, radii=radii, age=np.zeros_like(radii)), free
