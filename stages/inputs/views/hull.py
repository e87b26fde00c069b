"""The visual hull: what lies inside the silhouettes of all views that see it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from ...compiled import compiled
from ...errors import InputError
from ...mesh.polygons import Floats, Ints
from ...render.views import COVERED, Views
from .node_grid import NodeGrid

PIXELS = 320
"""Silhouettes are taken at a size of about this for the hull."""
MARGIN = 0.02
"""Of the longest side, added to the box on every side."""
BAND = 2.5
"""Grid cells outside a silhouette beyond which nothing more is asked."""
ROUGH = 32
"""Cells along the longest side of the grid on which views that disagree are looked for."""
WORST = 3
SPECK = 0.01
"""Share of the volume of the largest piece below which a piece is left out."""


def signed_distances(views: Views, threads: int) -> Any:
    """In pixels, positive in the silhouettes, ``(N, H, W) float32``."""
    from scipy.ndimage import distance_transform_edt

    def one(mask: Any) -> Any:
        inside = mask >= COVERED
        away = distance_transform_edt(inside) - distance_transform_edt(~inside)
        return (away - np.where(inside, 0.5, -0.5)).astype(np.float32)

    with ThreadPoolExecutor(threads) as pool:
        return np.stack(list(pool.map(one, views.masks)))


def projections(views: Views) -> tuple[Floats, Floats]:
    """``(N, 3, 4)``, and pixels a length of the last row ``(N,)``."""
    rows, focal = [], []
    for camera in views.cameras:
        outer = np.column_stack([camera.rotation, camera.translation])
        if camera.orthographic:
            outer[2] = [0, 0, 0, 1]
        rows.append(camera.matrix @ outer)
        focal.append(np.sqrt(np.abs(np.linalg.det(camera.matrix[:2, :2]))))
    return np.stack(rows), np.array(focal)


@compiled
def hull_values(
    points: Any,
    projection: Any,
    focal: Any,
    distances: Any,
    leaves: Any,
    votes: int,
    band: float,
    values: Any,
) -> None:  # pragma: no cover
    """How far each of ``points (N, 3)`` is inside the hull, ``values (N,)``: the smallest of its
    distances to the silhouettes of the views that see it, ``votes`` smaller ones left out;
    ``-band`` where that is less or no view sees it.

    What lies beyond a side of a picture is outside, unless the silhouette ``leaves (N, 4)`` it
    there: on the left, right, top or bottom; then that view does not see it."""
    count, height, width = distances.shape
    least = np.empty(votes + 1)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        least[:] = np.inf
        for v in range(count):
            p = projection[v]
            depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if depth <= 0:
                continue
            column = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth - 0.5
            row = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth - 0.5
            beyond = (
                column < -0.5, column > width - 0.5, row < -0.5, row > height - 0.5
            )  # fmt: skip
            if beyond[0] or beyond[1] or beyond[2] or beyond[3]:
                outside = False
                for side in range(4):
                    if beyond[side] and not leaves[v, side]:
                        outside = True
                if not outside:
                    continue
            j = min(max(int(np.floor(column)), 0), width - 2)
            i = min(max(int(np.floor(row)), 0), height - 2)
            s, t = column - j, row - i
            d = (1 - t) * ((1 - s) * distances[v, i, j] + s * distances[v, i, j + 1]) + t * (
                (1 - s) * distances[v, i + 1, j] + s * distances[v, i + 1, j + 1]
            )
            d *= depth / focal[v]
            if beyond[0] or beyond[1] or beyond[2] or beyond[3]:
                d = -band
            if d < least[votes]:
                k = votes
                while k > 0 and least[k - 1] > d:
                    least[k] = least[k - 1]
                    k -= 1
                least[k] = d
                if least[votes] <= -band:
                    break
        values[n] = -band if np.isinf(least[votes]) else max(least[votes], -band)


class VisualHull:
    """Of ``views``; ``votes`` silhouettes may be wrong anywhere."""

    def __init__(self, views: Views, names: list[str], votes: int, threads: int) -> None:
        self.views, self.names, self.votes, self.threads = views, names, votes, threads
        factor = max(1, round(max(views.masks.shape[1:]) / PIXELS))
        small = replace(views, normals=None).shrunk(factor)
        self.distances = signed_distances(small, threads)
        self.projection, self.focal = projections(small)
        inside = self.distances > 0
        borders = (inside[:, :, 0], inside[:, :, -1], inside[:, 0], inside[:, -1])
        self.leaves = np.stack([border.any(axis=1) for border in borders], axis=1)

    def values(self, points: Floats, band: float) -> Floats:
        """See ``hull_values``."""
        result = np.empty(len(points))
        parts = np.array_split(np.arange(len(points)), self.threads)

        def one(part: Ints) -> None:
            found = np.empty(len(part))
            hull_values(
                points[part], self.projection, self.focal, self.distances, self.leaves,
                self.votes, band, found,
            )  # fmt: skip
            result[part] = found

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(one, parts))
        return result

    def box(self) -> Floats:
        """A box ``(2, 3)`` of what may be inside the boxes of all silhouettes, with a margin.

        Raises InputError when the views do not meet, or do not bound the object.
        """
        from scipy.optimize import linprog

        planes, owner = self._planes()
        scale = np.linalg.norm(planes[:, :3], axis=1)
        planes = planes / scale[:, None]
        kept = np.ones(len(self.names), dtype=bool)
        conflict = self._conflict(planes, owner)
        if conflict is not None:
            wrong = np.argsort(-conflict, kind="stable")[: int((conflict > 1e-9).sum())]
            if len(wrong) > self.votes:
                raise InputError(
                    f"the silhouettes of the {len(self.names)} views do not meet; "
                    + self._worst(wrong)
                )
            kept[wrong] = False
        sides = []
        for axis in range(3):
            for sign in (1.0, -1.0):
                used = kept.copy()
                for _ in range(self.votes + 1):
                    rows = used[owner]
                    goal = np.zeros(3)
                    goal[axis] = sign
                    found = linprog(goal, -planes[rows, :3], planes[rows, 3], bounds=(None, None))
                    if found.status != 0:
                        break
                    slack = planes[rows, :3] @ found.x + planes[rows, 3]
                    used[owner[rows][np.abs(slack) < 1e-9 * (1 + np.abs(found.fun))]] = False
                    last = sign * found.fun
                if found.status != 0:
                    raise InputError(
                        "the views do not bound the object; add views from other sides"
                    )
                sides.append(last)
        low, high = np.array(sides[0::2]), np.array(sides[1::2])
        margin = MARGIN * float((high - low).max())
        return np.stack([low - margin, high + margin])

    def _planes(self) -> tuple[Floats, Ints]:
        """Rows ``(P, 4)`` that are not negative, times (x, 1), within the boxes of the silhouettes,
        and the views they are of. Where a silhouette leaves the picture it bounds nothing."""
        rows, owner = [], []
        for number, (p, away) in enumerate(zip(self.projection, self.distances, strict=True)):
            inside = away > 0
            for axis in range(2):
                covered = np.flatnonzero(inside.any(axis=axis))
                if len(covered) == 0:
                    continue
                last = inside.shape[1 - axis] - 1
                if covered[0] > 0:
                    rows.append(p[axis] - covered[0] * p[2])
                    owner.append(number)
                if covered[-1] < last:
                    rows.append((covered[-1] + 1.0) * p[2] - p[axis])
                    owner.append(number)
            if np.abs(p[2, :3]).max() > 0:
                rows.append(p[2])
                owner.append(number)
        return np.array(rows), np.array(owner)

    def _conflict(self, planes: Floats, owner: Ints) -> Floats | None:
        """By how much each view's planes have to give way for a point to satisfy all; None if
        there is one."""
        from scipy.optimize import linprog
        from scipy.sparse import csr_array, hstack

        found = linprog(np.zeros(3), -planes[:, :3], planes[:, 3], bounds=(None, None))
        if found.status == 0:
            return None
        count = len(self.names)
        give = csr_array(
            (-np.ones(len(owner)), (np.arange(len(owner)), owner)), (len(owner), count)
        )
        found = linprog(
            np.concatenate([np.zeros(3), np.ones(count)]),
            hstack([csr_array(-planes[:, :3]), give]),
            planes[:, 3],
            bounds=[(None, None)] * 3 + [(0, None)] * count,
        )
        return np.asarray(found.x[3:])

    def _worst(self, views: Ints) -> str:
        names = [self.names[number] for number in views[:WORST]]
        return f"the worst are {', '.join(names)}: check their masks and cameras"

    def disagreement(self, box: Floats) -> str:
        """Which views exclude what most of the others have inside."""
        edge = float(np.ptp(box, axis=0).max()) / ROUGH
        shape = np.maximum(1, np.ceil(np.ptp(box, axis=0) / edge)).astype(int)
        points = box[0] + edge * (np.stack(list(np.ndindex(*shape))) + 0.5)
        inside = np.empty((len(self.names), len(points)), dtype=bool)
        found = np.empty(len(points))
        for v in range(len(self.names)):
            hull_values(
                points, self.projection[v : v + 1], self.focal[v : v + 1],
                self.distances[v : v + 1], self.leaves[v : v + 1], 0, edge, found,
            )  # fmt: skip
            inside[v] = found > 0
        agree = inside.sum(axis=0)
        against = (~inside[:, agree == agree.max()]).mean(axis=1)
        worst = np.argsort(-against, kind="stable")[: np.count_nonzero(against)]
        return self._worst(worst)

    def surface(self, box: Floats, cells: int) -> tuple[Floats, Ints]:
        """Vertices and outward triangles of the hull on a grid of ``cells`` along the longest side.

        Raises InputError when no node of the grid is inside.
        """
        edge = float(np.ptp(box, axis=0).max()) / cells
        grid = NodeGrid.around(box, edge)
        values = self.values(grid.nodes, BAND * edge)
        if not (values > 0).any():
            raise InputError(
                f"no voxel is inside all {len(self.names)} silhouettes; {self.disagreement(box)}"
            )
        return grid.surface(np.where(values == 0, -1e-9 * edge, values), SPECK)
