"""Agreement of polygons: all spheres at the corners of a face must meet in the same two points.

Newton's method makes the corners agree to rounding, and ``faults`` finds the faces that remain
wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.geometry import face_frames, limited
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.spheres import near_pairs
from ..voronoi.certificate import sound_rings
from .polygon_problem import Corners, Planes, incidence, incidence_gradient
from .spheres import SAFE, Spheres

NEWTON = 16
"""Largest number of Newton steps."""
HOPELESS = 0.02
"""Deviation of a face after two of these steps, in edge lengths, above
which it is left as it is."""
SOFT = 1e-4, 1e-7
"""Relative increase of the diagonal of the system: in the first steps, where equations may
contradict each other, and after the HOPELESS faces are left out."""
SHIFTED = 0.1
"""The polygons at a vertex are faulty if these steps move it further, in edge lengths."""
TURNED = 0.7
"""A face is faulty if the cosine of its normals before and after is less."""


@dataclass(frozen=True)
class Polygons:
    """Polygons with spheres at their corners, in model units."""

    faces: PolygonMesh
    """The faces, with the centres of the certified triangles as vertices."""
    corners: Corners
    planes: Planes
    spheres: Spheres
    """The spheres. Their ``triangles (F, 3)`` are the three corners of each face
    that define its pair."""

    @classmethod
    def of_triangles(cls, spheres: Spheres) -> Polygons:
        """Triangles as polygons."""
        mesh = PolygonMesh.of_triangles(spheres.centres, spheres.triangles)
        corners = Corners.of(mesh, np.zeros(mesh.face_count, dtype=bool))
        none = np.zeros(0, np.int64)
        return cls(mesh, corners, Planes(none, np.zeros((0, 3)), np.zeros(0)), spheres)

    @property
    def large(self) -> NDArray[np.bool_]:
        """Whether each face ``(F,)`` has more than three corners."""
        return np.asarray(self.faces.valences > 3)

    def placed(self) -> PolygonMesh:
        """The faces, with the present centres as vertices."""
        return self.faces.with_vertices(self.spheres.centres)

    def facts(self) -> dict[str, Any]:
        """Figures for the manifest: faces by number of corners, and the share of
        the area in polygons."""
        area, _, _ = face_frames(self.placed())
        corners, count = np.unique(self.faces.valences, return_counts=True)
        return {
            "by_corners": {str(k): int(n) for k, n in zip(corners, count, strict=True)},
            "share": float(area[self.large].sum() / area.sum()),
        }


def agreeing(polygons: Polygons, free: NDArray[np.bool_], close: float) -> Polygons:
    """The polygons after Newton steps towards the agreement of all corners.

    Each step is the smallest change of the spheres that are ``free (V,)`` that solves the
    linearised equations. Steps end when no corner deviates by more than ``close``, in edge lengths.
    """
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.linalg import cg

    state, corners, planes = polygons.spheres, polygons.corners, polygons.planes
    size = state.face_lengths[corners.face]
    length = state.lengths[planes.vertex]
    unit = np.repeat(np.where(free, state.lengths, 0.0), 4)
    solved = np.ones(polygons.faces.face_count, dtype=bool)
    held = np.ones(len(length), dtype=bool)
    narrow = planes.columns.reshape(-1)
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


def faults(polygons: Polygons, before: Floats, close: float, threads: int) -> Floats:
    """A measure of what is wrong with each face ``(F,)``, 0 if nothing is.

    ``before (V, 3)`` are the centres before the Newton steps. ``close`` is the deviation of corners
    that is allowed, in edge lengths.
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
    point, sphere = near_pairs(mesh, points, state.centres, state.reach, 0.0, threads)
    power = ((points[point] - state.centres[sphere]) ** 2).sum(axis=1) - state.radii[sphere] ** 2
    inside = power < SAFE
    depth = (2 * SAFE - power[inside]) / state.lengths[sphere[inside]] ** 2
    np.maximum.at(at, sphere[inside], depth)
    np.maximum.at(fault, point[inside] % count, depth)
    np.maximum.at(fault, face, at[corner])
    return fault
