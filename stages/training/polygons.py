"""Exact polygons: certified triangles are merged, and their spheres made to agree.

Gauss-Newton steps make the corners of each polygon agree while they follow the shape; the weight of
the agreement grows. Newton steps then solve its equations to rounding. Faulty polygons are divided
into their triangles again, the worst first, until none is left. So in the end the certificate is no
weaker than that of the triangles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.edge_table import EdgeTable
from ..mesh.geometry import face_frames
from ..mesh.polygons import Floats, Ints
from ..remesh.plane_parts import PlaneParts, plane_parts
from ..remesh.stars import groups, merged
from ..solvers.gauss_newton import TERMS, descend, first_damping
from .agreement import Polygons, agreeing, faults
from .polygon_problem import Corners, Planes, PolygonProblem
from .spheres import Spheres, rings_around

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..mesh.creases import Creases
    from ..mesh.queries.true_surface import TrueSurface
    from ..progress import Progress

STEPS, ROUND = 20, 5
"""Number of steps of the first round, and of each later one. Closest points are
found every ROUND steps."""
FACTORS = 30.0, 1.5, 1000.0
"""Weight of the agreement: the first, its growth in a step, and the largest."""
EASE = (0.05, 0.05, 0.1, 0.2, 0.5)
"""Share of the shape's weight in the first rounds; the last value is for all later rounds. Corners
that are held close to the shape before they agree would never agree."""
SMOOTH = (10.0, 10.0, 5.0, 2.5, 1.0)
"""Factor of the weight of smoothness in these rounds."""
ROUNDS = 40
"""Largest number of rounds. Polygons that are still faulty then become triangles."""
ROOM = 0.12
"""The first ``delta_f^2`` of polygons, which sets the first radii, in squared edge lengths."""
NEAR, EXACT = 1e-6, 1e-10
"""Deviation of corners that is allowed after the Newton steps, in edge lengths: during the
rounds, and at the end."""
NEARBY = 3
"""Number of rings around a faulty triangle in which the polygon that causes it is sought."""
RESTORED = 2
"""Number of rings around a fault without polygons nearby that are restored
to the certified state."""
BEFORE = 100_000
"""Checkpoints are numbered from here on, after those of the triangles."""


@dataclass
class _Merging:
    """The certified triangles, the polygons that they are merged into, and
    their present spheres."""

    certified: Spheres
    plane: PlaneParts
    group: Ints
    """The polygon ``(T,)`` of each triangle, as the lowest index of its triangles."""
    centres: Floats
    radii: Floats
    free: NDArray[np.bool_]
    """The vertices ``(V,)`` that have not been restored for good."""
    suspect: NDArray[np.bool_]
    """The groups ``(T,)`` that were faulty in the last round."""

    @classmethod
    def of(cls, certified: Spheres, surface: TrueSurface, share: float) -> _Merging:
        """The first merging, with polygons over at most ``share`` of the area."""
        mesh = certified.as_mesh()
        table = EdgeTable.of(mesh.triangles)
        plane = plane_parts(mesh, table, surface, certified.face_lengths)
        first, second = plane.part[table.triangles].T
        crease = mesh.on_crease(table.ends)
        flat = np.ones(len(mesh.vertices), dtype=bool)
        flat[table.ends[(first != second) & ~crease]] = False
        flat[mesh.triangles[plane.part < 0]] = False
        group = groups(mesh.vertices, mesh.triangles, mesh.rank, crease, flat, share)
        return cls(
            certified, plane, group, mesh.vertices.copy(), certified.radii.copy(),
            np.ones(len(flat), dtype=bool), np.zeros(len(group), dtype=bool),
        )  # fmt: skip

    def assembled(self) -> tuple[Polygons, Ints, Ints]:
        """The polygons, the vertex of each sphere, and the group of each face."""
        certified = self.certified
        mesh, owner = merged(certified.centres, certified.triangles, self.group)
        used = np.unique(mesh.face_vertices)
        number = np.full(mesh.vertex_count, -1)
        number[used] = np.arange(len(used))
        mesh = mesh.without_unused_vertices()
        part = np.where(mesh.valences > 3, self.plane.of_groups(self.group)[owner], -1)
        corners = Corners.of(mesh, part >= 0)
        there = part[mesh.corner_faces] >= 0
        pair = np.stack([mesh.face_vertices, part[mesh.corner_faces]])[:, there]
        vertex, part = np.unique(pair, axis=1)
        planes = Planes(vertex, self.plane.normal[part], self.plane.offset[part])
        creases = certified.creases.copy()
        creases[:, :2] = number[creases[:, :2]]
        spheres = Spheres(
            self.centres[used], self.radii[used], corners.defining, certified.lengths[used],
            certified.hold[used], certified.age[used], certified.rank[used], creases,
            certified.room[used],
        )  # fmt: skip
        return Polygons(mesh, corners, planes, spheres), used, owner

    def divide(self, chosen: Ints) -> None:
        """Divide the polygons of the groups ``chosen`` into triangles.

        Vertices that return get their certified positions plus the mean move of their neighbours.
        """
        triangles = self.certified.triangles
        opened = np.isin(self.group, chosen)
        inside = np.ones(len(self.centres), dtype=bool)
        inside[merged(self.certified.centres, triangles, self.group)[0].face_vertices] = False
        self.group = np.where(opened, np.arange(len(self.group)), self.group)
        back = np.zeros(len(self.centres), dtype=bool)
        back[triangles[opened]] = True
        back &= inside
        move = self.centres - self.certified.centres
        move[inside] = 0.0
        mean = EdgeTable.of(triangles).mean_of_neighbours(move)
        self.centres[back] = self.certified.centres[back] + mean[back]
        self.radii[back] = self.certified.radii[back]

    def restore(self, places: NDArray[np.bool_]) -> None:
        """Put the vertices ``places (V,)`` back to their certified positions for good.

        Polygons at these vertices are divided.
        """
        touched = self.group[places[self.certified.triangles].any(axis=1)]
        sizes = np.bincount(self.group, minlength=len(self.group))
        self.divide(np.unique(touched[sizes[touched] > 1]))
        self.centres[places] = self.certified.centres[places]
        self.radii[places] = self.certified.radii[places]
        self.free &= ~places

    def mend(self, polygons: Polygons, fault: Floats, used: Ints, owner: Ints, late: bool) -> None:
        """Divide the worst faulty polygons, by ``fault (F,)``, and restore faults without polygons
        nearby.

        Unless it is ``late``, only one polygon at a vertex is divided.
        """
        mesh, large = polygons.faces, polygons.large
        corner, face = mesh.face_vertices, mesh.corner_faces

        def around(values: Floats) -> Floats:
            """The largest value among the faces that share a vertex with each face."""
            vertex, result = np.zeros(mesh.vertex_count), np.zeros(mesh.face_count)
            np.maximum.at(vertex, corner, values[face])
            np.maximum.at(result, face, vertex[corner])
            return result

        # The polygon nearest to a faulty triangle is taken as the cause.
        blamed, lonely = np.where(large, fault, 0.0), np.where(large, 0.0, fault)
        for _ in range(NEARBY):
            lonely = around(np.where(around(blamed) > 0, 0.0, lonely))
            blamed = np.maximum(blamed, np.where(large, lonely, 0.0))
        near = around(blamed)
        alone = (fault > 0) & (near == 0)
        self.divide(owner[(blamed > 0) & (late | (blamed >= near))])
        if alone.any():
            places = np.zeros(len(self.centres), dtype=bool)
            places[used[corner[alone[face]]]] = True
            self.restore(rings_around(self.certified.triangles, places, RESTORED))


def train_polygons(
    certified: Spheres,
    surface: TrueSurface,
    creases: Creases | None,
    weights: Mapping[str, float],
    share: float,
    checkpoints: Checkpoints,
    stored: Mapping[str, Any],
    progress: Progress,
    threads: int,
) -> tuple[Polygons, Floats, int]:
    """Polygons over at most ``share`` of the area of ``certified`` triangles.

    Returns them with the losses ``(steps, 4)`` and the number of rounds. ``weights`` has exclusion,
    shape, smooth and radius. ``stored`` is added to every checkpoint.
    """
    merging = _Merging.of(certified, surface, share)
    number, history = 0, np.zeros((0, len(TERMS)))
    found = checkpoints.latest()
    if found is not None and "group" in found[1]:
        state = found[1]
        merging = replace(
            merging, group=state["group"], centres=state["moved"], radii=state["moved_radii"],
            free=state["moving"].astype(bool), suspect=state["suspect"].astype(bool),
        )  # fmt: skip
        number, history = state["polygon_round"].item(), state["polygon_history"]
    while number < ROUNDS:
        polygons, used, owner = merging.assembled()
        polygons, losses = _trained(
            polygons, certified.radii[used], merging.free[used], surface, creases, weights, number,
            progress, threads,
        )  # fmt: skip
        history = np.concatenate([history, losses])
        before = polygons.spheres
        exact = agreeing(polygons, merging.free[used], NEAR / 10)
        wrong = faults(exact, before.centres, NEAR, threads)
        number += 1
        if number >= len(EASE) and not wrong.any():
            exact = agreeing(exact, merging.free[used], EXACT / 100)
            wrong = faults(exact, before.centres, EXACT, threads)
            if not wrong.any():
                return exact, history, number
        merging.centres[used], merging.radii[used] = before.centres, before.radii
        # In early rounds, faults that may disappear by themselves get one more round.
        late = number > len(EASE)
        resisting = np.where(merging.suspect[owner] | late, wrong, 0.0)
        merging.suspect[:] = False
        merging.suspect[owner[wrong > 0]] = True
        if resisting.any():
            merging.mend(exact, resisting, used, owner, late)
        now: dict[str, Any] = {
            **stored, "group": merging.group, "moved": merging.centres,
            "moved_radii": merging.radii, "moving": merging.free, "suspect": merging.suspect,
            "polygon_round": number, "polygon_history": history,
        }  # fmt: skip
        checkpoints.save(BEFORE + number, now.copy)
    return Polygons.of_triangles(certified), history, number


def _trained(
    polygons: Polygons,
    certified: Floats,
    free: NDArray[np.bool_],
    surface: TrueSurface,
    creases: Creases | None,
    weights: Mapping[str, float],
    number: int,
    progress: Progress,
    threads: int,
) -> tuple[Polygons, Floats]:
    """The polygons after the steps of a round, and the losses ``(steps, 4)``.

    ``certified (V,)`` are the radii of the triangles' spheres.
    """
    faces, state = polygons.faces, polygons.spheres
    wanted = _wanted(polygons, certified)
    if number == 0:
        state = replace(state, radii=wanted)
    first, growth, most = FACTORS
    steps = ROUND if number else STEPS
    factors = [most if number else min(most, first * growth**i) for i in range(steps)]
    turn = min(number, len(EASE) - 1)
    weights = {
        **weights,
        "shape": EASE[turn] * weights["shape"],
        "smooth": SMOOTH[turn] * weights["smooth"],
    }
    damping, history = first_damping(len(certified)), []
    progress.start(f"polygons {number}" if number else "polygons", steps)
    for begin in range(0, steps, ROUND):
        problem = PolygonProblem(
            faces, polygons.corners, polygons.planes, state, faces.vertices, wanted, free, surface,
            creases, weights, threads,
        )  # fmt: skip
        state, losses, damping = descend(problem, state, factors[begin : begin + ROUND], damping)
        history.append(losses)
        progress.advance(begin + ROUND, f"loss {losses[-1].sum():.4g}")
    return replace(polygons, spheres=state), np.concatenate(history)


def _wanted(polygons: Polygons, certified: Floats) -> Floats:
    """The radii ``(V,)`` that suit all polygons at a vertex; elsewhere the certified ones."""
    faces, spheres = polygons.faces, polygons.spheres
    corner, face = faces.face_vertices, faces.corner_faces
    _, _, middle = face_frames(faces)
    square = ((faces.vertices[corner] - middle[face]) ** 2).sum(axis=1)
    square += ROOM * (spheres.face_room * spheres.face_lengths)[face] ** 2
    wanted = np.zeros(len(certified))
    large = polygons.large[face]
    np.maximum.at(wanted, corner[large], np.sqrt(square[large]))
    return np.maximum(wanted, certified)
