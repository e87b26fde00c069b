"""Triangles with the edge lengths that are asked for, or as many triangles as are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..optimize.fitting import vertex_errors
from .edge_table import Sized
from .geometry import triangle_normals
from .polygons import Floats, Ints
from .remesh import remesh
from .sizing import THINNEST, LengthField, evened, limits
from .stretching import metrics

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..sources.true_surface import TrueSurface
    from .creases import Creases

    Count = Callable[[Floats], float]

CELL = np.sqrt(3) / 4
"""Area of a triangle over its squared edge length."""
SMALLEST = 0.25
"""The least length, in units of the largest, where none is asked for."""
FINEST, COARSEST = 0.25, 4.0
"""The same, and the largest, of varied lengths, in units of what even ones would be."""
THIN = 0.8
"""Edge of a triangle over the thickness that it still resolves, of varied lengths: these are short
already where a thin part is curved."""
LOOKS, LATER = 3, 12
"""How often the errors are looked at, and the iterations of remeshing after each look."""
NEAR = 0.02
"""Share of the triangles by which they may be missed before the lengths are scaled once more."""
HALVINGS = 40
THINNER = 1.25
"""Factor by which thin parts and gaps may get longer edges where there are not enough triangles."""


@dataclass(frozen=True)
class Spacing:
    """The edge lengths that are asked for, in units of h0."""

    length: float
    """Of edges where nothing asks for others."""
    shortest: float | None = None
    longest: float | None = None
    faces: int | None = None
    """How many triangles there are to be; by default as many as have edges of ``length``."""

    @property
    def varied(self) -> bool:
        """Whether edges are short where the surface is hard to follow, and long elsewhere."""
        asked = (self.shortest, self.longest, self.faces) != (None, None, None)
        return asked and (self.shortest is None or self.shortest != self.longest)


def spaced(
    vertices: Floats, triangles: Ints, surface: TrueSurface, creases: Creases | None,
    spacing: Spacing,
) -> tuple[Sized, int]:  # fmt: skip
    """The closed surface remeshed as ``spacing`` asks, and how many creases no edges follow.

    Varied lengths are found by looking at the errors of a triangulation: they stand for the
    curvature that its triangles cannot follow. Its own directions are those along which triangles
    become longer, and across which shorter.
    """
    base, smallest, largest, thinnest = spacing.length, SMALLEST, 1.0, THINNEST
    if spacing.varied:
        smallest, largest, thinnest = FINEST, COARSEST, THIN
        if spacing.faces is not None:
            area = triangle_normals(vertices, triangles)[1].sum()
            base = float(np.sqrt(area / (CELL * spacing.faces)))
    shortest = spacing.shortest or min(smallest * base, spacing.longest or np.inf)
    longest = spacing.longest or max(largest * base, shortest)
    points, most = limits(surface.samples, surface.normals, longest, creases, thinnest)
    field = LengthField(points, np.maximum(most, shortest))
    mesh = Sized(vertices.copy(), triangles.copy(), np.zeros(len(vertices)))
    if not spacing.varied:
        return mesh, remesh(mesh, field, surface, creases)
    wanted = np.full(len(points), base)
    even = field.graded(np.clip(most, shortest, base))
    faces = spacing.faces or _counting(mesh, field)(even)
    ratio = 1.0
    for look in range(LOOKS + 2):
        count = _counting(mesh, field)
        field.lengths = _fitted(count, field, wanted, most, (shortest, longest), faces / ratio)
        expected = count(field.lengths)
        missed = remesh(mesh, field, surface, creases, *([LATER, 1] if look else []))
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
