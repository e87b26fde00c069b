"""Exact polygons: certified triangles merged, and their spheres brought to agree.

Gauss-Newton steps bring the corners of every polygon to agree beside the shape, the weight of their
equations growing; steps of least change then solve these to rounding. Polygons that are at fault
are divided into their triangles again, the worst first, until none is: in the end the surface is at
least as certified as the triangles were.
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
"""Steps of the first round, and of each later one; closest points are looked for every ROUND."""
FACTORS = 30.0, 1.5, 1000.0
"""Weight of the agreement of corners: at first, its growth in a step, at the most."""
EASE = (0.05, 0.05, 0.1, 0.2, 0.5)
"""Share of the shape's weight in the first rounds, the last of them in all later ones: corners that
are held to the shape before they agree come to no agreement."""
SMOOTH = (10.0, 10.0, 5.0, 2.5, 1.0)
"""Factor to the weight of smoothness in these rounds."""
ROUNDS = 40
"""The most rounds; the triangles are what is left then."""
ROOM = 0.12
"""``delta_f^2`` that the radii beside polygons start with, in edge lengths squared."""
NEAR, EXACT = 1e-6, 1e-10
"""How far corners may be from agreeing after them, in edge lengths, during the rounds and at the
end."""
NEARBY = 3
"""Rings around a fault in which polygons are looked for."""
RESTORED = 2
"""Rings around a fault that no polygon is near which are put back as they were certified."""
BEFORE = 100_000
"""Checkpoints are numbered from here, behind those of the triangles that it starts from."""


@dataclass
class _Merging:
    """The certified triangles, what is merged of them, and where their spheres are by now."""

    certified: Spheres
    plane: PlaneParts
    group: Ints
    """The polygon of each triangle ``(T,)``, by the lowest of its triangles."""
    centres: Floats
    radii: Floats
    free: NDArray[np.bool_]
    """Vertices ``(V,)`` that have not been put back for good."""
    suspect: NDArray[np.bool_]
    """Groups ``(T,)`` that were at fault in the last round."""

    @classmethod
    def of(cls, certified: Spheres, surface: TrueSurface, share: float) -> _Merging:
        """Polygons over at most ``share`` of the area."""
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
        """The polygons, the vertex of each sphere and the group of each face."""
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
        """The polygons of groups ``chosen`` become triangles again, with the vertices between them
        where those were certified, moved as their neighbours are."""
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
        """The vertices ``places (V,)`` are where they were certified, and stay there; polygons at
        them become triangles."""
        touched = self.group[places[self.certified.triangles].any(axis=1)]
        sizes = np.bincount(self.group, minlength=len(self.group))
        self.divide(np.unique(touched[sizes[touched] > 1]))
        self.centres[places] = self.certified.centres[places]
        self.radii[places] = self.certified.radii[places]
        self.free &= ~places

    def mend(self, polygons: Polygons, fault: Floats, used: Ints, owner: Ints, late: bool) -> None:
        """Divide the worst polygons at ``fault (F,)``, no two at one vertex unless it is ``late``;
        a fault that no polygon is near is undone."""
        mesh, large = polygons.faces, polygons.large
        corner, face = mesh.face_vertices, mesh.corner_faces

        def around(values: Floats) -> Floats:
            """The largest value of the faces that share a vertex with each."""
            vertex, result = np.zeros(mesh.vertex_count), np.zeros(mesh.face_count)
            np.maximum.at(vertex, corner, values[face])
            np.maximum.at(result, face, vertex[corner])
            return result

        # Faults of triangles are those of the polygons nearest to them.
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
    """Polygons over at most ``share`` of the area of ``certified`` triangles, the losses ``(steps,
    4)`` and the number of rounds.

    ``weights``: exclusion, shape, smooth, radius. ``stored`` goes into every checkpoint.
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
        # What may come right by itself is given one more round.
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
    """The polygons after the steps of a round, and its losses; ``certified (V,)``: the radii of
    the triangles."""
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
    """The radii ``(V,)`` that suit all polygons at a vertex, and those certified elsewhere."""
    faces, spheres = polygons.faces, polygons.spheres
    corner, face = faces.face_vertices, faces.corner_faces
    _, _, middle = face_frames(faces)
    square = ((faces.vertices[corner] - middle[face]) ** 2).sum(axis=1)
    square += ROOM * (spheres.face_room * spheres.face_lengths)[face] ** 2
    wanted = np.zeros(len(certified))
    large = polygons.large[face]
    np.maximum.at(wanted, corner[large], np.sqrt(square[large]))
    return np.maximum(wanted, certified)
