"""Creases that are rounded, or under noise: where what is flat on either side would meet.

Normals on the edges of a grid are filtered so that they agree on either side of a crease and jump
at it (bilateral filter of normals, Zheng et al. 2011), points are drawn to the planes of these, and
dual contouring of both has sharp edges, which count where the surface is flat beside them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...mesh.creases import Chain, Creases
from ...mesh.geometry import triangle_normals
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints
from .contouring import STEP, Crossings, crossings, triangulated
from .sharp_edges import chains, sharp_edges

if TYPE_CHECKING:
    from ...mesh.queries.true_surface import TrueSurface

NODES = 4_000_000
"""Of the grid, at the most; with more, its step is longer than STEP."""
APPROACHES = 5
"""Steps along a grid's edge to the surface."""
STEEP = 0.1
"""Cosine of an edge and the normal from which on such a step is made."""
BLUR, WIDE, FAR = 0.6, 1.25, 3.1
"""Widths of the filters, and how far they reach, in steps of the grid."""
SAME_SHEET = -0.3
"""Cosine of two normals above which they are averaged."""
ALIKE = 20.0
"""Difference in degrees of normals that agree."""
ROUNDS, DRAWN = 8, 3
"""Of the filter, and of points drawn to the planes of their neighbours."""
RAW, CLEAN = 10.0, 3.0
"""Median angle in degrees between a normal and the mean around it, from which on the mean stands
for it, and below which there is no noise."""
REACH, FLAT = 3.75, 20.0
"""Within so many steps the surface beside a crease is flat if normals keep so many degrees."""
STRONG, WEAK = 0.5, 0.25
"""Share of half a disc that is flat on both sides of an edge: of those that make a crease, and of
those that carry it on."""
MOSTLY = 0.5
"""Share of a crease that strong edges make up."""
MEETINGS, SIDE = 3, 0.6
"""How often the two sides of a crease are looked for, this far from it in h0."""
ROUND = 0.05
"""Distance in h0 of where the two sides would meet from an exact surface, from which on what is
round is followed better without a crease: of right angles, that of a radius of an eighth."""
MADE = 0.3
"""Share of all that turns that is creases, below which the shape is not one with creases."""
JOIN, JOININGS = 2.5, 4
"""Creases that end this many steps from each other meet there, shorter ones are none; rounds."""
STRAIGHT = 0.5
"""Cosine from which on two creases that meet go straight on."""
SMOOTHINGS, FORTH, BACK = 5, 0.5, -0.53
"""Rounds of smoothing of creases under noise (Taubin 1995), and its two steps."""


def rounded(surface: TrueSurface, box: Floats, angle: float, exact: bool) -> list[Chain]:
    """Creases that turn by ``angle`` degrees or more within about half a voxel, in model units.

    They are where the two sides would meet; what is that far off an ``exact`` surface that it is
    better followed without is left out. ``box (2, 3)``: bounds.
    """
    step = max(STEP, float(np.cbrt((np.ptp(box, axis=0) + 4 * STEP).prod() / NODES)))
    found = crossings(
        surface.inside, lambda start, way: _approached(surface, start, way), box, step
    )
    if len(found.at) == 0:
        return []
    normals, tilt = _averaged(found, step)
    if tilt < RAW:
        normals = found.normal
    places, triangles = triangulated(_filtered(found, normals, step), step)
    edges, owners = sharp_edges(places, triangles, angle)
    facing, _ = triangle_normals(places, triangles)
    middle = places[edges].mean(axis=1)
    flat = np.minimum(
        *(_flatness(found, normals, middle, facing[owners[:, side]], step) for side in range(2))
    )
    length = np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1)
    edges = edges[_kept(edges, length, flat)]
    result = joined(chains(places, edges), JOIN * step)
    if sum(chain.length for chain in result) < MADE * length.sum():
        return []
    clean = tilt < CLEAN
    if clean or not exact:
        result = _met(surface, result)
    if exact and result:
        result = [chain for chain in result if _off(surface, chain) < ROUND]
    return result if clean else [Chain(_smoothed(chain), chain.closed) for chain in result]


def _off(surface: TrueSurface, chain: Chain) -> float:
    """Median distance of a chain from the surface."""
    foot, _ = surface.closest(chain.points)
    return float(np.median(np.linalg.norm(foot - chain.points, axis=1)))


def _met(surface: TrueSurface, chains: list[Chain]) -> list[Chain]:
    """The ``chains`` where the planes on their two sides meet; what met before still does."""
    if not chains:
        return []
    points = np.concatenate([chain.points for chain in chains])
    way = np.concatenate([np.gradient(chain.points, axis=0) for chain in chains])
    moved = _between(surface, points, way)
    last = np.cumsum([len(chain.points) for chain in chains]) - 1
    tips = np.concatenate([last - [len(chain.points) - 1 for chain in chains], last])
    _, place = np.unique(points[tips], axis=0, return_inverse=True)
    place = place.reshape(-1)
    mean = [np.bincount(place, moved[tips, k]) / np.bincount(place) for k in range(3)]
    moved[tips] = np.stack(mean, axis=1)[place]
    return [
        Chain(part, chain.closed)
        for part, chain in zip(np.split(moved, last[:-1] + 1), chains, strict=True)
    ]


def _between(surface: TrueSurface, points: Floats, way: Floats) -> Floats:
    """Where, from ``points (N, 3)`` of creases that go ``way (N, 3)``, the planes on both sides
    meet."""
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), np.finfo(float).tiny)
    at = points
    for _ in range(MEETINGS):
        _, middle = surface.closest(at)
        aside = np.cross(way, middle)
        size = np.linalg.norm(aside, axis=1, keepdims=True)
        aside /= np.maximum(size, np.finfo(float).tiny)
        (first, one), (second, other) = (
            surface.closest(at + side * SIDE * aside) for side in (1, -1)
        )
        planes = np.stack([one, other, way], axis=1)
        heights = np.stack(
            [np.einsum("ij,ij->i", normal, foot - at)
             for normal, foot in ((one, first), (other, second))] + [np.zeros(len(at))], axis=1
        )  # fmt: skip
        good = np.abs(np.linalg.det(planes)) > STEEP
        planes[~good] = np.eye(3)
        move = np.linalg.solve(planes, heights[:, :, None])[:, :, 0]
        good &= np.linalg.norm(move, axis=1) < SIDE
        at = np.where(good[:, None], at + move, at)
    return at


def _approached(surface: TrueSurface, start: Floats, way: Floats) -> tuple[Floats, Floats]:
    """Where the surface crosses the ways from ``start (N, 3)``, and its normals there."""
    share = np.full(len(start), 0.5)
    length = np.linalg.norm(way, axis=1)
    for _ in range(APPROACHES):
        at = start + share[:, None] * way
        foot, normal = surface.closest(at)
        slope = np.einsum("ij,ij->i", normal, way)
        height = np.einsum("ij,ij->i", normal, foot - at)
        steep = np.abs(slope) > STEEP * length
        share = np.where(steep, share + height / np.where(steep, slope, 1.0), share)
        share = np.clip(share, 0.0, 1.0)
    at = start + share[:, None] * way
    return at, surface.closest(at)[1]


class _Neighbours:
    """Weighted sums over the points around each point."""

    def __init__(self, points: Floats, reach: float) -> None:
        from scipy.spatial import cKDTree

        pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
        own = np.arange(len(points))
        self.here = np.concatenate([pairs[:, 0], pairs[:, 1], own])
        self.there = np.concatenate([pairs[:, 1], pairs[:, 0], own])
        way = points[self.here] - points[self.there]
        self.square, self.count = np.einsum("ij,ij->i", way, way), len(points)

    def angles(self, normals: Floats) -> Floats:
        cosine = np.einsum("ij,ij->i", normals[self.here], normals[self.there])
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)))

    def sums(self, values: Floats) -> Floats:
        """Of ``values (P,)`` of the pairs, ``(N,)``."""
        return np.asarray(np.bincount(self.here, values, minlength=self.count), np.float64)

    def mean(self, weights: Floats, normals: Floats) -> Floats:
        """The unit normals of the sums of ``normals (N, 3)``."""
        total = np.stack([self.sums(weights * normals[self.there, k]) for k in range(3)], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.asarray(total / np.maximum(length, np.finfo(float).tiny))


def _averaged(found: Crossings, step: float) -> tuple[Floats, float]:
    """Means of the normals around each crossing, and the median angle to these in degrees."""
    around = _Neighbours(found.at, FAR * step)
    near = np.exp(-around.square / (2 * (BLUR * step) ** 2))
    same = np.cos(around.angles(found.normal)) > SAME_SHEET
    mean = around.mean(near * same, found.normal)
    cosine = np.einsum("ij,ij->i", mean, found.normal)
    return mean, float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _filtered(found: Crossings, normals: Floats, step: float) -> Crossings:
    """The crossings with normals that jump at creases, on the planes that these make."""
    around = _Neighbours(found.at, FAR * step)
    near = np.exp(-around.square / (2 * (WIDE * step) ** 2))

    def weights() -> Floats:
        return np.asarray(near * np.exp(-((around.angles(normals) / np.radians(ALIKE)) ** 2) / 2))

    for _ in range(ROUNDS):
        normals = around.mean(weights(), normals)
    weight, at = weights(), found.at
    total = around.sums(weight)
    for _ in range(DRAWN):
        way = at[around.there] - at[around.here]
        height = np.einsum("ij,ij->i", normals[around.here], way)
        at = at + (around.sums(weight * height) / total)[:, None] * normals
    return Crossings(found.cell, found.quad, at, normals)


def _flatness(found: Crossings, normals: Floats, at: Floats, facing: Floats, step: float) -> Floats:
    """Which share of half a disc around each place ``at (E, 3)`` faces as ``facing (E, 3)``."""
    from scipy.spatial import cKDTree

    if len(at) == 0:
        return np.zeros(0)
    pairs = cKDTree(at).sparse_distance_matrix(
        cKDTree(found.at), REACH * step, output_type="coo_matrix"
    )
    cosine = np.einsum("ij,ij->i", normals[pairs.col], facing[pairs.row])
    row, col = (index[cosine > np.cos(np.radians(FLAT))] for index in (pairs.row, pairs.col))
    # Of an area A a grid has A (|n_x| + |n_y| + |n_z|) / step^2 crossings.
    area = step**2 / np.abs(normals[col]).sum(axis=1)
    return np.bincount(row, area, minlength=len(at)) / (np.pi * (REACH * step) ** 2 / 2)


def _kept(edges: Ints, length: Floats, flat: Floats) -> Ints:
    """Rows of the connected weak edges that are mostly strong."""
    weak = np.flatnonzero(flat > WEAK)
    if len(weak) == 0:
        return weak
    a = edges[weak, 0]
    size = int(edges.max()) + 1
    _, label = components(size, edges[weak])
    total = np.bincount(label[a], length[weak], minlength=size)
    strong = np.bincount(label[a], length[weak] * (flat[weak] > STRONG), minlength=size)
    return np.asarray(weak[(strong > MOSTLY * total)[label[a]]])


def joined(chains: list[Chain], reach: float) -> list[Chain]:
    """Chains that meet where they end within ``reach`` of each other, without short ones, those
    that end nowhere near another included, and without doubles."""
    closed = [chain for chain in chains if chain.closed]
    lines = [chain.points for chain in chains if not chain.closed]
    for _ in range(JOININGS):
        if not lines:
            break
        place, ends = _nodes(lines, 0.1 * reach)
        degree = np.bincount(ends.reshape(-1), minlength=len(place))
        length = np.array([Chain(points, closed=False).length for points in lines])
        short = length < reach
        # Ends that are alone go to the nearest other one.
        distance, near = _nearest_other(place)
        alone = np.flatnonzero((degree == 1) & (distance < reach))
        pairs = np.concatenate([ends[short], np.stack([alone, near[alone]], axis=1)])
        place, number = _merged(place, degree, pairs)
        ends = number[ends]
        degree = np.bincount(ends[~short].reshape(-1), minlength=len(place))
        spur = (degree[ends].min(axis=1) == 1) & (length < 2 * reach)
        kept = np.flatnonzero(~short & ~spur & (ends[:, 0] != ends[:, 1]))
        lines = [
            _distinct(np.concatenate([place[ends[k, :1]], lines[k][1:-1], place[ends[k, 1:]]]))
            for k in kept
        ]
        lines = _through(_single(lines, ends[kept], reach), reach)
    return [Chain(points, closed=False) for points in lines] + closed


def _distinct(points: Floats) -> Floats:
    """Without those that are where the one before is."""
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 0
    return np.asarray(points[np.append(True, moved)])


def _nodes(lines: list[Floats], near: float) -> tuple[Floats, Ints]:
    """Where lines end, those nearer to each other than ``near`` once, and the two of each line."""
    tips = np.concatenate([points[[0, -1]] for points in lines])
    _, first, number = np.unique(tips, axis=0, return_index=True, return_inverse=True)
    place, number = tips[first], number.reshape(-1)
    from scipy.spatial import cKDTree

    pairs = cKDTree(place).query_pairs(near, output_type="ndarray")
    degree = np.bincount(number, minlength=len(place))
    place, moved = _merged(place, degree, pairs.astype(np.int64))
    return place, moved[number].reshape(-1, 2)


def _nearest_other(place: Floats) -> tuple[Floats, Ints]:
    from scipy.spatial import cKDTree

    if len(place) < 2:
        return np.full(len(place), np.inf), np.zeros(len(place), dtype=np.int64)
    distance, near = cKDTree(place).query(place, 2)
    return distance[:, 1], near[:, 1]


def _merged(place: Floats, degree: Ints, pairs: Ints) -> tuple[Floats, Ints]:
    """The places that connected ``pairs (K, 2)`` make, and the number of each old one; where most
    lines ended."""
    found, label = components(len(place), pairs)
    most = np.zeros(found, dtype=np.int64)
    np.maximum.at(most, label, degree)
    counts = (degree == most[label]).astype(float)
    total = np.bincount(label, counts)
    merged = [np.bincount(label, counts * place[:, k]) / total for k in range(3)]
    return np.stack(merged, axis=1), label


def _single(lines: list[Floats], ends: Ints, reach: float) -> list[Floats]:
    """Of lines beside each other between the same two places the shortest one."""
    order = sorted(range(len(lines)), key=lambda k: Chain(lines[k], closed=False).length)
    kept: dict[tuple[int, int], list[Floats]] = {}
    for k in order:
        beside = kept.setdefault((int(ends[k].min()), int(ends[k].max())), [])
        dense = Creases([Chain(lines[k], closed=False)]).dense
        far = [
            np.linalg.norm(dense - Creases([Chain(other, closed=False)]).closest(dense)[0], axis=1)
            for other in beside
        ]
        if all(distance.max() > reach for distance in far):
            beside.append(lines[k])
    return [points for group in kept.values() for points in group]


def _through(lines: list[Floats], reach: float) -> list[Floats]:
    """Lines that go straight on where two of them meet as one."""
    done: list[Floats] = []
    while lines:
        line = lines.pop()
        grown = True
        while grown:
            grown = False
            for _side in range(2):
                line = line[::-1]
                touching = [
                    (k, side) for k, other in enumerate(lines) for side in (0, -1)
                    if (other[side] == line[-1]).all()
                ]  # fmt: skip
                if len(touching) != 1 or any((other[side] == line[-1]).all()
                                             for other in done for side in (0, -1)):  # fmt: skip
                    continue
                k, side = touching[0]
                other = lines[k] if side == 0 else lines[k][::-1]
                if (other[-1] == line[0]).all() or _turn(line, other, reach) < STRAIGHT:
                    continue
                lines.pop(k)
                line = np.concatenate([line, other[1:]])
                grown = True
        done.append(line)
    return done


def _turn(line: Floats, other: Floats, reach: float) -> float:
    """Cosine of the ways of two lines, within ``reach`` before and after the place where they
    meet."""
    before = line[np.linalg.norm(line - line[-1], axis=1) > reach]
    after = other[np.linalg.norm(other - other[0], axis=1) > reach]
    u = line[-1] - (before[-1] if len(before) else line[0])
    v = (after[0] if len(after) else other[-1]) - other[0]
    return float(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))


def _smoothed(chain: Chain) -> Floats:
    """The points of a chain without their noise; its ends stay, and it does not shrink."""
    points = chain.points.copy()
    for _ in range(SMOOTHINGS):
        for step in (FORTH, BACK):
            middle = 0.5 * (points[:-2] + points[2:])
            points[1:-1] += step * (middle - points[1:-1])
            if chain.closed and len(points) > 3:
                points[0] += step * (0.5 * (points[1] + points[-2]) - points[0])
                points[-1] = points[0]
    return points
