"""Triangles with the edge lengths that are asked for, or as many triangles as are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.creases import embed
from ..mesh.edge_table import Sized
from ..mesh.geometry import sample_triangles, triangle_normals
from ..mesh.polygons import Floats, Ints
from ..mesh.queries.thickness import thin_lengths
from .curvature_metric import metrics
from .fitting import vertex_errors
from .length_field import CELL, THINNEST, LengthField, evened, separation, thickness, triangles_of
from .remeshing import EMBEDDED, divide, remesh, thin_out

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..mesh.creases import Creases
    from ..mesh.model_frame import ModelFrame
    from ..mesh.queries.true_surface import TrueSurface

    Count = Callable[[Floats], float]

PLACES, DISTINCT = 3, 2.0
"""How many places are named, and how far apart they are, in units of h0."""
SMALLEST = 0.25
"""The least length beside creases, in units of the largest, where none is asked for."""
LEAST = 0.03
"""The least length at all, in units of h0: of shorter edges the margin of the certificate, which is
in units of h0, would ask too much."""
FLOORS = 5
"""How many least lengths between creases are tried."""
MORE = 4000.0, 1.5
"""Triangles, and how many times the usual number, that close creases may take."""
MANY = 2.0
"""Triangles at first, over those that there are to be, above which edges are contracted before
anything else."""
SAMPLES, MOST_SAMPLES = 20_000, 400_000
"""Points at which the thickness is measured: at first, and at the most where there are to be many
triangles."""
PER_FACE = 2.0
"""Such points for each triangle that there is to be, at the least."""
FINEST, COARSEST = 0.25, 4.0
"""The same, and the largest, of varied lengths, in units of what even ones would be."""
THIN = 0.8
"""Edge of a triangle over the distance of two creases, of varied lengths: these are short already
where it matters."""
LOOKS, LATER = 3, 12
"""How often the errors are looked at, and the iterations of remeshing after each look."""
NEVER = 1_000_000
"""More iterations than there are: creases that are embedded already are not looked for again."""
FIRST = 12
"""Iterations of remeshing before the first look."""
NEAR = 0.02
"""Share of the triangles by which they may be missed before the lengths are scaled once more."""
HALVINGS = 40
THINNER = 1.25
"""Factor by which thin parts and gaps may get longer edges where there are not enough triangles."""


@dataclass(frozen=True)
class Demand:
    """How many triangles the thinnest parts ask for, and where these are, in model units."""

    triangles: float
    places: Floats
    """Up to PLACES that ask for the shortest edges, ``(K, 3)``."""
    lengths: Floats
    """Those edges, ``(K,)``."""

    def named(self, frame: ModelFrame) -> str:
        """The places and edges, in the input's units."""
        return "; ".join(
            f"edges of {frame.spacing * length:.3g} at ({', '.join(f'{x:.6g}' for x in at)})"
            for length, at in zip(self.lengths, frame.input_from_model(self.places), strict=True)
        )


class TooManyTriangles(Exception):
    """There are more in ``demand`` than there may be."""

    def __init__(self, demand: Demand) -> None:
        super().__init__(demand)
        self.demand = demand


@dataclass(frozen=True)
class Spacing:
    """The edge lengths that are asked for, in units of h0."""

    length: float
    """Of edges where nothing asks for others."""
    shortest: float | None = None
    longest: float | None = None
    faces: int | None = None
    """How many triangles there are to be; by default as many as have edges of ``length``."""
    most: int = 10_000_000
    """How many triangles there may be at the most."""

    @property
    def varied(self) -> bool:
        """Whether edges are short where the surface is hard to follow, and long elsewhere."""
        asked = (self.shortest, self.longest, self.faces) != (None, None, None)
        return asked and (self.shortest is None or self.shortest != self.longest)


def spaced(
    vertices: Floats, triangles: Ints, surface: TrueSurface, creases: Creases | None,
    spacing: Spacing, exact: bool = False,
) -> tuple[Sized, int]:  # fmt: skip
    """The closed surface remeshed as ``spacing`` asks, and how many creases no edges follow.

    ``exact``: the triangles are those of the true surface, so creases are among their edges. Varied
    lengths are found by looking at the errors of a triangulation: they stand for the curvature that
    its triangles cannot follow. Its own directions are those along which triangles become longer,
    and across which shorter. Raises TooManyTriangles.
    """
    base, smallest, largest, apart = spacing.length, SMALLEST, 1.0, THINNEST
    area = float(triangle_normals(vertices, triangles)[1].sum())
    if spacing.varied:
        smallest, largest, apart = FINEST, COARSEST, THIN
        if spacing.faces is not None:
            base = float(np.sqrt(area / (CELL * spacing.faces)))
    beside = spacing.shortest or min(smallest * base, spacing.longest or np.inf)
    shortest = spacing.shortest or (min(LEAST, beside) if exact else beside)
    longest = spacing.longest or max(largest * base, beside)
    if exact:
        points, most = limits(vertices, triangles, creases, longest, beside, apart, shortest)
    else:
        # Rays would meet the folds of a first surface.
        points, most = sampled_limits(surface, creases, longest, beside, apart)
    plain = len(points) - (0 if creases is None else len(creases.dense))
    field = LengthField(points, np.maximum(most, shortest))
    if exact and creases is not None:
        most = _affordable(field, most, plain, (shortest, beside), area)
        field.lengths = field.graded(np.maximum(most, shortest))
    mesh = Sized(vertices.copy(), triangles.copy(), field(vertices))
    if spacing.faces is None:
        asked = demand(area, points[:plain], field.lengths[:plain], most[:plain])
        if asked.triangles > spacing.most:
            raise TooManyTriangles(asked)
    missed, embedded = 0, EMBEDDED
    if exact and creases is not None:
        missed, embedded = embed(mesh, creases), NEVER
    if len(triangles) > MANY * _counting(mesh, field)(field.lengths):
        thin_out(mesh, field)
    if exact:
        divide(mesh, field, surface)
    if not spacing.varied:
        return mesh, remesh(mesh, field, surface, creases, embedded=embedded) + missed
    wanted = np.full(len(points), base)
    even = field.graded(np.clip(most, shortest, base))
    faces = spacing.faces or _counting(mesh, field)(even)
    ratio = 1.0
    for look in range(LOOKS + 2):
        count = _counting(mesh, field)
        field.lengths = _fitted(count, field, wanted, most, (shortest, longest), faces / ratio)
        expected = count(field.lengths)
        again = (LATER, 1) if look else (FIRST, embedded)
        found = remesh(mesh, field, surface, creases, *again)
        missed = found if look else found + missed
        if look >= LOOKS and abs(len(mesh.triangles) / faces - 1) < NEAR:
            break
        ratio = len(mesh.triangles) / expected
        if look < LOOKS:
            errors, _ = vertex_errors(surface, mesh.vertices, mesh.triangles)
            near = _nearest(mesh.vertices, points)
            wanted = evened(field.lengths, errors[near])
            field.metrics = metrics(mesh)[near]
            mesh.metric = field.metric
    return mesh, missed


def limits(
    vertices: Floats, triangles: Ints, creases: Creases | None, longest: float, beside: float,
    apart: float, shortest: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Points of a surface and the largest lengths there, ``(N, 3), (N,)``: at most ``longest``,
    less where the shape or a gap is thin, or creases are close to each other: ``apart`` times that
    distance. In a wedge they are no less than ``beside``, between creases than ``shortest``."""
    count = SAMPLES
    _, area = triangle_normals(vertices, triangles)
    while True:
        points, owner = sample_triangles(vertices, triangles, count, np.random.default_rng(0))
        most = np.minimum(
            thin_lengths(vertices, triangles, points, owner, creases, beside), longest
        )
        faces = triangles_of(area.sum(), np.maximum(most, LEAST))
        if count >= min(MOST_SAMPLES, PER_FACE * faces):
            break
        count = int(min(MOST_SAMPLES, 2 * PER_FACE * faces))
    return _with_creases(points, most, creases, longest, shortest, apart)


def sampled_limits(
    surface: TrueSurface, creases: Creases | None, longest: float, beside: float, apart: float
) -> tuple[Floats, Floats]:
    """The same at the samples of a surface whose triangles are not known, as far as these tell."""
    thin = thickness(surface.samples, surface.normals, longest / apart)
    most = np.minimum(apart * thin, longest)
    return _with_creases(surface.samples, most, creases, longest, beside, apart)


def _with_creases(
    points: Floats, most: Floats, creases: Creases | None, longest: float, shortest: float,
    apart: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    """``points`` and lengths with those of creases."""
    if creases is None:
        return points, most
    close = apart * separation(creases.dense, creases.tangents, longest / apart)
    most = np.append(most, np.clip(close, shortest, longest))
    return np.concatenate([points, creases.dense]), most


def _affordable(
    field: LengthField, most: Floats, count: int, floor: tuple[float, float], area: float
) -> Floats:
    """The largest lengths ``most (N,)``, raised between close creases, whose points are those from
    ``count`` on, as far as they would take many triangles more on ``area`` than the larger
    ``floor`` does."""

    def raised(least: float) -> tuple[Floats, float]:
        wanted = most.copy()
        wanted[count:] = np.maximum(wanted[count:], least)
        graded = field.graded(np.maximum(wanted, floor[0]))
        return wanted, triangles_of(area, graded[:count])

    usual, faces = raised(floor[1])
    for least in np.geomspace(*floor, FLOORS)[:-1]:
        found, needed = raised(least)
        if needed <= MORE[0] + MORE[1] * faces:
            return found
    return usual


def distinct(points: Floats, value: Floats, among: NDArray[np.bool_]) -> Ints:
    """Up to PLACES of ``points (N, 3)`` with the least ``value (N,)``, apart from each other."""
    left = np.flatnonzero(among)
    left = left[np.argsort(value[left], kind="stable")]
    found: list[int] = []
    while len(left) and len(found) < PLACES:
        found.append(int(left[0]))
        left = left[np.linalg.norm(points[left] - points[left[0]], axis=1) > DISTINCT]
    return np.array(found, dtype=np.int64)


def demand(area: float, points: Floats, lengths: Floats, most: Floats) -> Demand:
    """Of a surface of that ``area`` with ``lengths (N,)`` at its ``points (N, 3)``; ``most (N,)``
    are those before they were graded, and made no less than LEAST."""
    # What is thinner than that asks for shorter edges all the same.
    needed = np.minimum(lengths, np.maximum(most, 0.25 * LEAST))
    worst = distinct(points, most, np.ones(len(points), dtype=bool))
    return Demand(triangles_of(area, needed), points[worst], most[worst])


def _fitted(
    count: Count, field: LengthField, wanted: Floats, most: Floats,
    between: tuple[float, float], faces: float,
) -> Floats:  # fmt: skip
    """Graded lengths in proportion to ``wanted (N,)`` and no larger than ``most (N,)``, of about
    ``faces`` triangles; where that many are not enough for thin parts, these get longer ones."""

    def scaled(factor: float, thinner: float) -> Floats:
        return field.graded(np.clip(np.minimum(factor * wanted, thinner * most), *between))

    low, high = between[0] / wanted.max(), between[1] / wanted.min()
    thin = [1.0, 1.0]
    if count(scaled(high, 1.0)) > faces:
        low, thin = high, [1.0, THINNER]
    for _ in range(HALVINGS):
        factor, thinner = np.sqrt(low * high), np.sqrt(thin[0] * thin[1])
        if count(scaled(factor, thinner)) > faces:
            low, thin[0] = factor, thinner
        else:
            high, thin[1] = factor, thinner
    return scaled(high, thin[1])


def _counting(mesh: Sized, field: LengthField) -> Count:
    """What tells how many triangles the surface of ``mesh`` has with lengths at the field's
    points."""
    near = field.nearest(mesh.vertices[mesh.triangles].mean(axis=1))
    _, areas = triangle_normals(mesh.vertices, mesh.triangles)

    def count(lengths: Floats) -> float:
        return float((areas / (CELL * lengths[near] ** 2)).sum())

    return count


def _nearest(vertices: Floats, points: Floats) -> Ints:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(vertices).query(points)[1])
