"""Spheres at the vertices of a triangle surface. They define the generators in closed form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import limited
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.spheres import held, near_pairs
from ..remesh.operations import fold_cosines
from .losses import triangle_pairs

FIRST_RADIUS = 0.8
"""Radius of a sphere at the start, in edge lengths."""
SMALLEST = 0.1
"""``delta_f`` of the substitute for a missing pair, in edge lengths."""
LEAST_ROOM = 0.05
"""Smallest value of ``room``, for edges that are folded flat, whose pairs would have no room."""
REACH = 2.0
"""Generators and spheres that are closer to each other than this, in edge lengths, can meet in a
few steps."""
SAFE = 2e-5
"""Smallest power, in units of h0^2, at which a generator counts as outside a sphere."""


@dataclass(frozen=True)
class Spheres:
    """A triangle surface with spheres at its vertices, in model units."""

    centres: Floats
    radii: Floats
    triangles: Ints
    lengths: Floats
    """Mean length ``(V,)`` of the edges at each vertex when they were last changed."""
    hold: Floats
    """Share ``(V,)`` of the shape's weight at each vertex, 1 unless a repair has reduced it."""
    age: Floats
    """Number of rounds of repair ``(V,)`` in which each vertex was at an intruder."""
    rank: Ints
    """The rank ``(V,)`` of each vertex: 0 if it is free, 1 on a crease, 2 at a corner."""
    creases: Ints
    """The edges on creases ``(K, 3)``: their two ends, and the number of their chain."""
    room: Floats
    """Share ``(V,)`` of a pair's usual offset. It is less on creases with acute angles, because in
    a wedge both generators of a face must lie on its own side of the bisecting plane."""

    @classmethod
    def at(cls, mesh: Sized) -> Spheres:
        """Spheres with the first radii at the vertices of ``mesh``."""
        length = edge_lengths(mesh.vertices, mesh.triangles)
        ones = np.ones_like(length)
        return cls(
            mesh.vertices, FIRST_RADIUS * length, mesh.triangles, length, ones, 0 * ones,
            mesh.rank, mesh.creases, _room(mesh),
        )  # fmt: skip

    @classmethod
    def stored(cls, arrays: Mapping[str, Any]) -> Spheres:
        """The spheres of a checkpoint."""
        return cls(*(arrays[item.name] for item in fields(cls)))

    @property
    def face_lengths(self) -> Floats:
        """The mean of ``lengths`` over the corners of each face, ``(F,)``."""
        return np.asarray(self.lengths[self.triangles].mean(axis=1))

    @property
    def smallest(self) -> Floats:
        """The offset ``(F,)`` of the substitute for a missing pair."""
        return SMALLEST * self.face_room * self.face_lengths

    @property
    def face_room(self) -> Floats:
        """The smallest ``room`` at the corners of each face, ``(F,)``."""
        return np.asarray(self.room[self.triangles].min(axis=1))

    @property
    def reach(self) -> Floats:
        """Radii ``(V,)`` of balls with all generators whose power to a sphere is below 2 SAFE.

        Beside a small sphere these are further away than a share of its radius.
        """
        return np.asarray(np.sqrt(self.radii**2 + 2 * SAFE))

    def pairs(self) -> triangle_pairs.Pairs:
        """The pairs of all faces, where they exist."""
        return triangle_pairs.radical_pairs(self.centres, self.radii, self.triangles)

    def generators(self) -> tuple[Floats, Floats]:
        """The generators ``(2F, 3)``, outer ones first, and ``delta_f^2 (F,)``.

        A missing pair gets substitutes close to its triangle, however far its spheres are from
        meeting, because the diagram must be bounded.
        """
        pairs, floor = self.pairs(), self.smallest**2
        middle = self.centres[self.triangles].mean(axis=1)
        near = middle + limited(pairs.centre - middle, self.face_lengths)
        missing = pairs.square <= floor
        pairs = replace(pairs, centre=np.where(missing[:, None], near, pairs.centre))
        return pairs.points(floor), pairs.square

    def intruded(self, threads: int) -> NDArray[np.bool_]:
        """The vertices whose sphere contains an intruder, or that are at a
        triangle without a pair."""
        return self.intrusion(threads) > 0

    def intrusion(self, threads: int) -> Floats:
        """The depth of the deepest intruder in the sphere of each vertex, ``(V,)``.

        It is a power in squared edge lengths. It is 1 at a triangle without a pair, and 0 if there
        is no intruder.
        """
        points, square = self.generators()
        mesh = PolygonMesh.of_triangles(self.centres, self.triangles)
        point, sphere = near_pairs(mesh, points, self.centres, self.reach, 0.0, threads)
        power = ((points[point] - self.centres[sphere]) ** 2).sum(axis=1) - self.radii[sphere] ** 2
        found = np.zeros(len(self.centres))
        wrong = power < SAFE
        depth = (2 * SAFE - power[wrong]) / self.lengths[sphere[wrong]] ** 2
        np.maximum.at(found, sphere[wrong], depth)
        found[self.triangles[square <= self.smallest**2]] = 1.0
        return found

    def meeting(self, free: NDArray[np.bool_], threads: int) -> tuple[Ints, NDArray[np.bool_]]:
        """The vertices ``(V',)`` and faces ``(F,)`` on which the ``free (V,)`` spheres depend.

        These are the faces around them and their neighbours, generators and spheres that can meet
        those that move in a few steps, and all corners of these faces.
        """
        points, _ = self.generators()
        reach, count = REACH * self.lengths, len(self.triangles)
        moving = free[self.triangles].any(axis=1)
        faces = np.asarray(rings_around(self.triangles, free, 1)[self.triangles].any(axis=1))
        for point, _ in held(points, self.centres[free], reach[free], threads):
            faces[point % count] = True
        vertices = np.zeros_like(free)
        for _, sphere in held(points[np.tile(moving, 2)], self.centres, reach, threads):
            vertices[sphere] = True
        vertices[self.triangles[faces]] = True
        return np.flatnonzero(vertices), faces

    def part(self, vertices: Ints, faces: NDArray[np.bool_]) -> Spheres:
        """The spheres at ``vertices (V',)``, sorted, with those ``faces (F,)``, without creases.

        The corners of these faces must be among the vertices.
        """
        values = {
            item.name: getattr(self, item.name)[vertices]
            for item in fields(self)
            if item.name not in ("triangles", "creases")
        }
        triangles = np.searchsorted(vertices, self.triangles[faces])
        return Spheres(**values, triangles=triangles, creases=self.creases[:0])

    def with_part(self, vertices: Ints, part: Spheres) -> Spheres:
        """These spheres with the centres and radii of ``part`` at ``vertices (V',)``."""
        centres, radii = self.centres.copy(), self.radii.copy()
        centres[vertices], radii[vertices] = part.centres, part.radii
        return replace(self, centres=centres, radii=radii)

    def as_mesh(self) -> Sized:
        """Centres, triangles and lengths as a mesh, which carries radius, hold and age."""
        carried = np.stack([self.radii, self.hold, self.age], axis=1)
        return Sized(self.centres, self.triangles, self.lengths, carried, self.rank, self.creases)

    @classmethod
    def of_mesh(cls, mesh: Sized) -> Spheres:
        """The spheres of a mesh as ``as_mesh`` returns it."""
        radii, hold, age = mesh.carried.T[:3]
        return cls(
            mesh.vertices, radii, mesh.triangles, mesh.length, hold, age, mesh.rank, mesh.creases,
            _room(mesh),
        )  # fmt: skip


def rings_around(triangles: Ints, marked: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """``marked (V,)``, and the vertices up to ``rings`` rings around them."""
    for _ in range(rings):
        grown = marked.copy()
        grown[triangles[marked[triangles].any(axis=1)]] = True
        marked = grown
    return marked


def _room(mesh: Sized) -> Floats:
    """The tangent of half the angle between the two sides of a crease, at most 1, ``(V,)``."""
    room = np.ones(len(mesh.vertices))
    if len(mesh.creases):
        table = EdgeTable.of(mesh.triangles)
        table = table.rows(mesh.on_crease(table.ends))
        cosine, _ = fold_cosines(mesh, table)
        share = np.sqrt((1 + cosine) / np.maximum(1 - cosine, np.finfo(float).tiny))
        share = np.clip(share, LEAST_ROOM, 1.0)
        np.minimum.at(room, table.ends.reshape(-1), np.repeat(share, 2))
    return room


def edge_lengths(vertices: Floats, triangles: Ints) -> Floats:
    """Mean length of the edges at each vertex, ``(V,)``."""
    table = EdgeTable.of(triangles)
    length, ends = table.lengths(vertices), table.ends.reshape(-1)
    total = np.bincount(ends, np.repeat(length, 2), minlength=len(vertices))
    return np.asarray(total / np.maximum(np.bincount(ends, minlength=len(vertices)), 1))


def intrusion_gain(mesh: Sized, table: EdgeTable) -> Floats:
    """The decrease of intrusion by a flip, for the two triangles of an edge and the opposite
    spheres.

    The mesh carries the radii in its first column. The gain is -1 where there is no intrusion.
    """
    radii = mesh.carried[:, 0]

    def intrusion(first: list[Ints], second: list[Ints]) -> Floats:
        worst = np.full(len(table.ends), -np.inf)
        for corners, sphere in ((first, second[2]), (second, first[2])):
            triangles = np.stack(corners, 1)
            floor = (SMALLEST * mesh.length[triangles].mean(axis=1)) ** 2
            points = triangle_pairs.radical_pairs(mesh.vertices, radii, triangles).points(floor)
            arm = points - np.concatenate([mesh.vertices[sphere]] * 2)
            power = np.einsum("ij,ij->i", arm, arm) - np.concatenate([radii[sphere]] * 2) ** 2
            worst = np.maximum(worst, -power.reshape(2, -1).min(axis=0))
        return worst / mesh.edge_target(table.ends) ** 2

    (a, b), (c, d) = table.ends.T, table.opposite.T
    now, then = intrusion([a, b, c], [b, a, d]), intrusion([d, c, a], [c, d, b])
    return np.where(now > 0, now - then, -1.0)
