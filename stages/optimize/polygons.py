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

from ..surface.edge_table import EdgeTable
from ..surface.geometry import face_frames, limited
from ..surface.plane_parts import PlaneParts, plane_parts
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.spheres import near_pairs
from ..surface.stars import groups, merged
from ..voronoi.certificate import sound_rings
from .descent import TERMS, descend, first_damping
from .polygon_problem import Corners, Planes, PolygonProblem, incidence, incidence_gradient
from .spheres import SAFE, Spheres, rings_around

if TYPE_CHECKING:
    from ..artifacts.checkpoints import Checkpoints
    from ..contract import Progress
    from ..sources.true_surface import TrueSurface
    from ..surface.creases import Creases

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
ROOM = 0.25
"""``delta_f^2`` that the radii beside polygons start with, in edge lengths squared."""
NEWTON = 16
"""Steps of least change."""
NEAR, ROUNDED = 1e-6, 1e-12
"""How far corners may be from agreeing after them, in edge lengths, during the rounds and at the
end."""
HOPELESS = 0.02
"""What a face may be off after two of these steps; beyond it the face is left as it is."""
SOFT = 1e-4, 1e-7
"""Added to the diagonal of their system, relative to it: in the first of them, where equations may
contradict each other, and in those after the HOPELESS are out."""
SHIFTED = 0.1
"""Move of a centre in these steps, in edge lengths, from which on its polygons are at fault."""
TURNED = 0.7
"""Cosine of a face's normal before and after, below which it is at fault."""
NEARBY = 3
"""Rings around a fault in which polygons are looked for."""
RESTORED = 2
"""Rings around a fault that no polygon is near which are put back as they were certified."""
BEFORE = 100_000
"""Checkpoints are numbered from here, behind those of the triangles that it starts from."""


@dataclass(frozen=True)
class Polygons:
    """Polygons with spheres at their corners, in model units."""

    faces: PolygonMesh
    """Over the centres as they were certified."""
    corners: Corners
    planes: Planes
    spheres: Spheres
    """Its ``triangles (F, 3)`` are the corners of each face that define its pair."""

    @classmethod
    def of_triangles(cls, spheres: Spheres) -> Polygons:
        """Triangles as they are."""
        mesh = PolygonMesh.of_triangles(spheres.centres, spheres.triangles)
        corners = Corners.of(mesh, np.zeros(mesh.face_count, dtype=bool))
        none = np.zeros(0, np.int64)
        return cls(mesh, corners, Planes(none, np.zeros((0, 3)), np.zeros(0)), spheres)

    @property
    def large(self) -> NDArray[np.bool_]:
        """Faces ``(F,)`` with more than three corners."""
        return np.asarray(self.faces.valences > 3)

    def placed(self) -> PolygonMesh:
        """The faces over the centres."""
        return self.faces.with_vertices(self.spheres.centres)

    def facts(self) -> dict[str, Any]:
        """The faces by their corners and the share of the area in polygons, for the manifest."""
        area, _, _ = face_frames(self.placed())
        corners, count = np.unique(self.faces.valences, return_counts=True)
        return {
            "by_corners": {str(k): int(n) for k, n in zip(corners, count, strict=True)},
            "share": float(area[self.large].sum() / area.sum()),
        }


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
        values = (certified.lengths, certified.hold, certified.age, certified.rank)
        lengths, hold, age, rank = (value[used] for value in values)
        spheres = Spheres(
            self.centres[used], self.radii[used], corners.defining, lengths, hold, age, rank,
            creases, certified.room[used],
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
        faults = _faults(exact, before.centres, NEAR, threads)
        number += 1
        if number >= len(EASE) and not faults.any():
            exact = agreeing(exact, merging.free[used], ROUNDED)
            faults = _faults(exact, before.centres, 10 * ROUNDED, threads)
            if not faults.any():
                return exact, history, number
        merging.centres[used], merging.radii[used] = before.centres, before.radii
        # What may come right by itself is given one more round.
        late = number > len(EASE)
        resisting = np.where(merging.suspect[owner] | late, faults, 0.0)
        merging.suspect[:] = False
        merging.suspect[owner[faults > 0]] = True
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


def agreeing(polygons: Polygons, free: NDArray[np.bool_], close: float) -> Polygons:
    """The polygons after steps of least change of the spheres that are ``free (V,)`` towards the
    agreement of all corners (Newton's method on the equations alone), until it is ``close``."""
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.linalg import cg

    state, corners, planes = polygons.spheres, polygons.corners, polygons.planes
    size = state.face_lengths[corners.face]
    length = state.lengths[planes.vertex]
    unit = np.repeat(np.where(free, state.lengths, 0.0), 4)
    solved = np.ones(polygons.faces.face_count, dtype=bool)
    held = np.ones(len(length), dtype=bool)
    columns, narrow = np.zeros(0, np.int64), planes.columns.reshape(-1)
    for number in range(NEWTON):
        height, power, share, pairs = incidence(state, corners)
        agreement, aside = np.stack([height / size, power / size**2]), planes.heights(state.centres)
        if number > 1:
            solved[corners.face[np.abs(agreement).max(axis=0) > HOPELESS]] = False
            held &= np.abs(aside) < HOPELESS * length
        on = solved[corners.face].astype(np.float64)
        residual = np.concatenate([*(on * agreement), held * aside / length])
        if np.abs(residual).max(initial=0.0) < close:
            break
        wide, first, second = incidence_gradient(state, corners, share, pairs)
        values = np.concatenate(
            [
                (first * (on / size)[:, None]).reshape(-1),
                (second * (on / size**2)[:, None]).reshape(-1),
                (planes.normal * (held / length)[:, None]).reshape(-1),
            ]
        )
        columns = np.concatenate([wide.reshape(-1), wide.reshape(-1), narrow])
        entries = np.repeat([wide.shape[1], 3], [2 * len(wide), len(length)])
        rows = np.repeat(np.arange(len(residual)), entries)
        shape = (len(residual), len(unit))
        jacobian = csr_array((values * unit[columns], (rows, columns)), shape=shape)
        product = (jacobian @ jacobian.T).tocsr()
        diagonal = product.diagonal()
        softened = (1 + SOFT[number > 3]) * np.where(diagonal > 0, diagonal, 1.0)
        multiplier, _ = cg(
            product + diags_array(softened - diagonal), -residual, rtol=1e-3, maxiter=1000,
            M=diags_array(1 / softened),
        )  # fmt: skip
        step = (unit * (jacobian.T @ multiplier)).reshape(-1, 4)
        if not np.isfinite(step).all():
            break
        most = SHIFTED * state.lengths
        state = replace(
            state,
            centres=state.centres + limited(step[:, :3], most),
            radii=state.radii + np.clip(step[:, 3], -most, most),
        )
    return replace(polygons, spheres=state)


def _faults(polygons: Polygons, before: Floats, close: float, threads: int) -> Floats:
    """How much is wrong with each face ``(F,)``, 0 where all is well.

    ``before (V,)`` are the centres before the steps of least change; ``close``: how far corners may
    be from agreeing, in edge lengths.
    """
    state, corners, mesh = polygons.spheres, polygons.corners, polygons.placed()
    corner, face, count = mesh.face_vertices, mesh.corner_faces, mesh.face_count
    size = state.face_lengths
    points, square = state.generators()
    area, normal, _ = face_frames(mesh)
    wrong = (square <= state.smallest**2) | (state.radii <= 0)[corners.defining].any(axis=1)
    wrong |= ~sound_rings(mesh, area, normal)
    wrong |= np.einsum("ij,ij->i", normal, face_frames(polygons.faces)[1]) < TURNED
    fault = wrong.astype(np.float64)
    height, power, _, _ = incidence(state, corners)
    off = np.maximum(np.abs(height) / size[corners.face], np.abs(power) / size[corners.face] ** 2)
    np.maximum.at(fault, corners.face, np.where(off > close, 1 + off, 0.0))
    at = np.linalg.norm(state.centres - before, axis=1) / state.lengths
    at[at < SHIFTED] = 0.0
    aside = np.abs(polygons.planes.heights(state.centres))
    np.maximum.at(at, polygons.planes.vertex, np.where(aside > close, 1 + aside, 0.0))
    point, sphere = near_pairs(mesh, points, state.centres, state.radii, 0.02, threads)
    power = ((points[point] - state.centres[sphere]) ** 2).sum(axis=1) - state.radii[sphere] ** 2
    inside = power < SAFE
    depth = (2 * SAFE - power[inside]) / state.lengths[sphere[inside]] ** 2
    np.maximum.at(at, sphere[inside], depth)
    np.maximum.at(fault, point[inside] % count, depth)
    np.maximum.at(fault, face, at[corner])
    return fault
