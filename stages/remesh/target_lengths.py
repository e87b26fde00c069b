"""Remeshing to given edge lengths, or to a given number of triangles.

Edge lengths are decided here: ``spaced`` limits them by the thickness of parts and gaps
(``limits``) and by the distance of creases, and fits them to the wanted number of triangles.
"""

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
"""Number of places that are named in an error, and their smallest distance in units of h0."""
SMALLEST = 0.25
"""Shortest edge beside creases, as a share of the largest, if no shortest one is given."""
LEAST = 0.03
"""Shortest edge of all, in units of h0. For shorter ones the margin of the certificate, which is in
units of h0, would demand too much."""
FLOORS = 5
"""Number of shortest edges between creases that are tried."""
MORE = 4000.0, 1.5
"""Creases that are close may add this number of triangles, and the triangles may become
so many times as many."""
MANY = 2.0
"""If the input has more than this number of triangles for each triangle of the result, its edges
are contracted first."""
SAMPLES, MOST_SAMPLES = 20_000, 400_000
"""Number of points at which the thickness is measured: at first, and at most if there
will be many triangles."""
PER_FACE = 2.0
"""Smallest number of such points for each triangle of the result."""
FINEST, COARSEST = 0.25, 4.0
"""Shortest and longest of varied edges, divided by the length that even edges would have."""
THIN = 0.8
"""Largest varied edge, divided by the distance of two creases. Varied edges are short where it
matters, so that this is larger than THINNEST."""
LOOKS, LATER = 3, 12
"""Number of times that the errors are measured, and of remeshing iterations after each."""
NEVER = 1_000_000
"""A number of iterations that is never reached, for creases that are embedded already."""
FIRST = 12
"""Number of remeshing iterations before the errors are first measured."""
NEAR = 0.02
"""Largest relative deviation from the wanted number of triangles at which lengths
are not scaled again."""
HALVINGS = 40
"""Number of steps of the bisection that finds a number of triangles."""
THINNER = 1.25
"""Factor by which edges on thin parts and gaps may be longer if there are not enough triangles."""


@dataclass(frozen=True)
class Demand:
    """The number of triangles that thin parts need, and the thinnest places, in model units."""

    triangles: float
    places: Floats
    """At most PLACES places with the shortest edges, ``(K, 3)``."""
    lengths: Floats
    """The edge lengths at these places, ``(K,)``."""

    def named(self, frame: ModelFrame) -> str:
        """The places and edge lengths as text, in the unit of the input."""
        return "; ".join(
            f"edges of {frame.spacing * length:.3g} at ({', '.join(f'{x:.6g}' for x in at)})"
            for length, at in zip(self.lengths, frame.input_from_model(self.places), strict=True)
        )


class TooManyTriangles(Exception):
    """The ``demand`` is for more triangles than are allowed."""

    def __init__(self, demand: Demand) -> None:
        super().__init__(demand)
        self.demand = demand


@dataclass(frozen=True)
class Spacing:
    """The wanted edge lengths, in units of h0."""

    length: float
    """The length of edges where nothing limits it."""
    shortest: float | None = None
    longest: float | None = None
    faces: int | None = None
    """The wanted number of triangles; None is as many as have edges of ``length``."""
    most: int = 10_000_000
    """Largest number of triangles that is allowed."""

    @property
    def varied(self) -> bool:
        """Whether edges are short where the surface is hard to follow, and long elsewhere."""
        asked = (self.shortest, self.longest, self.faces) != (None, None, None)
        return asked and (self.shortest is None or self.shortest != self.longest)


def spaced(
    vertices: Floats, triangles: Ints, surface: TrueSurface, creases: Creases | None,
    spacing: Spacing, exact: bool = False,
) -> tuple[Sized, int]:  # fmt: skip
    """The closed surface remeshed according to ``spacing``, and the number of creases without
    edges.

    With ``exact`` the triangles are those of the true surface, so that creases are among their
    edges. Varied lengths follow from the errors of a first triangulation, which are large where its
    triangles do not follow the curvature. Edges become longer along the direction of least
    curvature, and shorter across it. Raises TooManyTriangles.
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
        # The triangles of a first surface have folds, which rays would take for thin parts.
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
    """Points of a surface ``(N, 3)``, and the longest edges there ``(N,)``.

    They are at most ``longest``, and shorter where the shape or a gap is thin. Where creases are
    close, they are ``apart`` times the distance of these. They are not shorter than ``beside`` in a
    wedge, and than ``shortest`` between creases.
    """
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
    """The same from the samples of ``surface``, for a surface whose triangles are not known."""
    thin = thickness(surface.samples, surface.normals, longest / apart)
    most = np.minimum(apart * thin, longest)
    return _with_creases(surface.samples, most, creases, longest, beside, apart)


def _with_creases(
    points: Floats, most: Floats, creases: Creases | None, longest: float, shortest: float,
    apart: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    """``points`` and ``most``, followed by the points of creases and the longest edges there."""
    if creases is None:
        return points, most
    close = apart * separation(creases.dense, creases.tangents, longest / apart)
    most = np.append(most, np.clip(close, shortest, longest))
    return np.concatenate([points, creases.dense]), most


def _affordable(
    field: LengthField, most: Floats, count: int, floor: tuple[float, float], area: float
) -> Floats:
    """The longest edges ``most (N,)``, made longer between close creases if these need too many
    triangles.

    The points from ``count`` on are those of creases. Triangles are compared with the number for
    the larger ``floor`` on ``area``.
    """

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
    """The indices of at most PLACES of ``points (N, 3)`` with the least ``value (N,)``,
    apart from each other."""
    left = np.flatnonzero(among)
    left = left[np.argsort(value[left], kind="stable")]
    found: list[int] = []
    while len(left) and len(found) < PLACES:
        found.append(int(left[0]))
        left = left[np.linalg.norm(points[left] - points[left[0]], axis=1) > DISTINCT]
    return np.array(found, dtype=np.int64)


def demand(area: float, points: Floats, lengths: Floats, most: Floats) -> Demand:
    """The demand of a surface with ``area`` and edge ``lengths (N,)`` at ``points (N, 3)``.

    ``most (N,)`` are the lengths before they were graded and limited to LEAST.
    """
    # Parts that are thinner than LEAST allows need shorter edges all the same.
    needed = np.minimum(lengths, np.maximum(most, 0.25 * LEAST))
    worst = distinct(points, most, np.ones(len(points), dtype=bool))
    return Demand(triangles_of(area, needed), points[worst], most[worst])


def _fitted(
    count: Count, field: LengthField, wanted: Floats, most: Floats,
    between: tuple[float, float], faces: float,
) -> Floats:  # fmt: skip
    """Graded lengths that give about ``faces`` triangles.

    They are proportional to ``wanted (N,)`` and at most ``most (N,)``. If so few triangles cannot
    respect that, edges on thin parts become longer, by THINNER at most.
    """

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
    """A function that estimates the number of triangles from lengths at the points of ``field``."""
    near = field.nearest(mesh.vertices[mesh.triangles].mean(axis=1))
    _, areas = triangle_normals(mesh.vertices, mesh.triangles)

    def count(lengths: Floats) -> float:
        return float((areas / (CELL * lengths[near] ** 2)).sum())

    return count


def _nearest(vertices: Floats, points: Floats) -> Ints:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(vertices).query(points)[1])
