"""From a point cloud to the closed surface that it samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mesh.geometry import triangle_areas, triangle_normals, vertex_normals
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.topology import bad_edges
from .gauss_reconstruction import PADDING, Dipoles, Grid, Single, outward
from .local_fits import Cloud
from .noise import noise, outliers, spacings, typical

COARSE, FINE = 64, 192
"""Edges of the grid along the longest side: where the inside is found, and at most afterwards."""
NODES = 1_600_000
"""Of the fine grid, about."""
CELL = 1.5
"""Points within an edge of the grid divided by this are one, at their mean."""
FINER = 0.6
"""Edge of the fine grid, in typical spacings, at least."""
AROUND = 2.0
"""Within so many edges of the grid, and noises, points are counted to see which are denser."""
WIDEST = 2.0
"""The side of a point's surface, in typical spacings, at most."""
COARSER = 0.7
"""Edge of the fine grid, in standard deviations of the noise, at least."""
STEPS, STEPS_NOISY, NOISY = 16, 4, 1.3
"""Steps to consistent normals; fewer from a noise of so many coarse edges."""
LEVEL = 2.0
"""Width within which the level follows the points: in edges of the grid and in noises."""
SMALLEST = 0.01
"""Pieces and cavities smaller than this share of the inside are left out, unless points hold
them."""
FEWEST, HELD = 20, 0.3
"""Points that hold a piece, and what share of those that would lie on its surface."""
FIT_ROUNDS, NEIGHBOURS = 3, 10
FIT_CELL = 0.6
"""Points within this many standard deviations of the noise are one for the fits."""
SMOOTHING = 10
"""Steps of smoothing what the fits say, from a noise of an edge of the grid."""
TURNED, UNFOLDINGS = 0.3, 10
"""Cosine between the normals before and after the fits below which a triangle has turned over, and
how often such ones are looked for."""
BOUND = 0.7
"""Mean curvature, over the noise, up to which the fits are believed."""
MISSED, MISSED_NOISES = 1.5, 5.0
"""Distance from which the surface misses a point, in typical spacings and in noises."""
TOO_FEW = 5.0
"""Points that must count in a fit for its surface to move there."""
UNDER = 1.08
"""The noise over the residual of the fits, which is a little less."""
LOUDEST = 0.15
"""Noise, over the size of the cloud, from which nothing can be found."""
STEPS_GIVEN = 2
"""Steps from given normals."""
AGREE, ALONG = 0.95, 0.5
"""Given normals are believed if this share of them is within a cosine of ALONG of the gradient of
the winding number that they make."""


@dataclass(frozen=True)
class Reconstruction:
    """The surface of a cloud, in the cloud's own coordinates."""

    vertices: Floats
    triangles: Ints
    noise: float
    """Standard deviation of the points about it."""
    spacing: float
    kept: NDArray[np.bool_]
    """Points ``(N,)`` that do not lie out."""
    agreement: float | None
    """Share of the given normals that agree with the winding number they make; they are used from
    AGREE."""
    missed: float
    """Share of the kept points that the surface does not pass near."""


def reconstruct(
    points: Floats, normals: Floats | None, given_noise: float | None, threads: int
) -> Reconstruction:
    """The closed surface of ``points (N, 3)``; ``normals (N, 3)`` are used if they fit the points.

    Raises InputError when the points have no inside.
    """
    from ...mesh.queries.triangle_tree import TriangleTree

    kept = ~outliers(points, threads)
    low = points[kept].min(axis=0)
    size = float(np.ptp(points[kept], axis=0).max())
    # At size 1, so that the scale changes nothing.
    unit = (points[kept] - low) / size
    apart = typical(spacings(unit, threads))
    if given_noise is None:
        blur = noise(unit, np.random.default_rng(0))
    else:
        blur = given_noise / size
    if blur > LOUDEST:
        raise InputError(
            f"a noise of {size * blur:g} is too large for a shape of size {size:g}; "
            "set --noise if the estimate is wrong"
        )
    coarse, first = _coarse(unit, apart, blur, threads)
    box = np.ptp(unit, axis=0) + 2 * PADDING
    least = max(1 / FINE, float(np.cbrt(box.prod() / NODES)))
    edge = float(np.clip(max(FINER * apart, COARSER * blur), least, 1 / COARSE))
    fine, weights, group = thinned(unit, edge / CELL)
    grid = Grid.around(fine, edge, threads)
    dipoles = Dipoles(grid, fine, _areas(grid, fine, weights, apart, blur), 0.5 * blur)
    steps = STEPS_NOISY if blur > NOISY / COARSE else STEPS
    start, agreement = _at(coarse, first, fine), None
    if normals is not None:
        given, agreement = _checked(dipoles, normals[kept], group)
        if agreement >= AGREE:
            start, steps = given, STEPS_GIVEN
    potential, _ = dipoles.consistent(start, steps)
    field = dipoles.above_surface(potential, max(LEVEL * edge, LEVEL * blur))
    vertices, triangles = _level_set(
        grid, _without_specks(grid, field, fine, apart, noisy=blur > edge)
    )
    vertices, blur = _fitted(
        vertices, triangles, unit, _at(grid, potential, unit), blur, given_noise is not None, edge,
        threads,
    )  # fmt: skip
    square, _, _ = TriangleTree(vertices, triangles, threads).closest(unit)
    missed = float((np.sqrt(square) > max(MISSED * apart, MISSED_NOISES * blur)).mean())
    return Reconstruction(
        low + size * vertices, triangles, size * blur, size * apart, kept, agreement, missed
    )


def thinned(points: Floats, cell: float) -> tuple[Floats, Floats, Ints]:
    """The mean of the points in each cubic cell, how many they are, and the cell of each point."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    number = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0) + 1))
    _, group, count = np.unique(number, return_inverse=True, return_counts=True)
    mean = _sums(group, points) / count[:, None]
    return mean, count.astype(np.float64), group


def _sums(group: Ints, vectors: Any) -> Floats:
    """The sum of the ``vectors (N, 3)`` of each of the groups, all of which have some."""
    return np.stack([np.bincount(group, axis) for axis in vectors.T.astype(np.float64)], axis=1)


def _coarse(points: Floats, apart: float, blur: float, threads: int) -> tuple[Grid, Single]:
    edge = 1 / COARSE
    some, weights, _ = thinned(points, edge / CELL)
    grid = Grid.around(some, edge, threads)
    return grid, Dipoles(grid, some, _areas(grid, some, weights, apart, blur), blur).least()


def _areas(grid: Grid, points: Floats, counts: Floats, apart: float, blur: float) -> Floats:
    """How much of the surface each of the thinned ``points (N, 3)`` stands for, in cells: as much
    as it has, and where noise has strewn them, more where there were more."""
    from scipy.ndimage import gaussian_filter

    at, to = grid.interpolation(points)
    width = max(AROUND, AROUND * blur / grid.spacing)
    given, all_ = (
        at @ gaussian_filter((to @ each).reshape(grid.shape), width, mode="constant").reshape(-1)
        for each in (counts.astype(np.float32), np.ones(len(points), np.float32))
    )
    share = counts * all_ / np.maximum(given, np.finfo(np.float32).tiny)
    cell = grid.spacing / CELL
    side = np.clip(spacings(points, grid.threads), cell, max(cell, WIDEST * apart))
    return np.asarray(share * (side / cell) ** 2)


def _at(grid: Grid, potential: Single, points: Floats) -> Single:
    """Unit normals at ``points`` against the gradient of ``potential``."""
    return outward(grid.gradient(potential, grid.interpolation(points)[0]))


def _checked(dipoles: Dipoles, normals: Floats, group: Ints) -> tuple[Single, float]:
    """Given ``normals (N, 3)``, as means of their ``group (N,)`` of points, outward, and the share
    of them that agrees with the winding number they make."""
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(size, np.finfo(float).tiny)
    mean = outward(-_sums(group, normals))
    potential = dipoles.potential(mean.astype(np.float32))
    if np.median(dipoles.values(potential)) < 0:  # outside it is zero
        normals, mean, potential = -normals, -mean, -potential
    found = outward(dipoles.gradient(potential))[group]
    agreement = float((np.einsum("ij,ij->i", normals, found) > ALONG).mean())
    return mean.astype(np.float32), agreement


def _without_specks(grid: Grid, field: Single, points: Floats, apart: float, noisy: bool) -> Single:
    """``field``, positive inside, without the small pieces and cavities that no ``points (N, 3)``
    lie about as densely as on a surface; of noisy points that says nothing."""
    from scipy.ndimage import binary_erosion, label

    first = np.floor((points - grid.origin) / grid.spacing).astype(np.int64)
    around = np.stack([first + corner for corner in np.ndindex(2, 2, 2)])
    corners = np.ravel_multi_index(tuple(np.moveaxis(around, 2, 0)), grid.shape)
    expected = (grid.spacing / max(apart, grid.spacing / CELL)) ** 2
    result = field.copy()
    for axis in range(3):  # the inside ends within the grid
        border = np.moveaxis(result, axis, 0)
        border[[0, -1]] = -np.abs(border[[0, -1]])
    for sign, joined in ((1, None), (-1, np.ones((3, 3, 3)))):
        solid = sign * result > 0
        part, count = label(solid, structure=joined)
        if count == 0:
            raise InputError("the points enclose nothing; give points of a closed surface")
        size = np.bincount(part.reshape(-1))
        small = size < SMALLEST * (result > 0).sum()
        if not noisy:
            edges = np.bincount(part[solid & ~binary_erosion(solid)], minlength=count + 1)
            held = np.bincount(part.reshape(-1)[corners].max(axis=0), minlength=count + 1)
            small &= held < np.maximum(FEWEST, HELD * expected * edges)
        small[0] = False
        result = np.where(small[part], -result, result)
    return result


def _level_set(grid: Grid, field: Single) -> tuple[Floats, Ints]:
    """Where ``field`` is zero: vertices and outward triangles."""
    import igl

    index = np.stack(np.unravel_index(np.arange(field.size), grid.shape[::-1]), axis=1)[:, ::-1]
    nodes = np.ascontiguousarray(grid.origin + grid.spacing * index)
    # The first index runs fastest, and what is negative is inside to marching cubes.
    values = np.ascontiguousarray(-field.T.astype(np.float64)).reshape(-1)
    vertices, triangles, _ = igl.marching_cubes(values, nodes, *map(int, grid.shape), 0.0)
    triangles = np.asarray(triangles, np.int64)
    if len(bad_edges(PolygonMesh.of_triangles(vertices, triangles))):
        raise InputError(
            "no closed surface passes through the points; remove outliers, or give more points"
        )
    return np.asarray(vertices), triangles


def _fitted(
    vertices: Floats,
    triangles: Ints,
    points: Floats,
    normals: Single,
    blur: float,
    known: bool,
    edge: float,
    threads: int,
) -> tuple[Floats, float]:
    """The vertices moved along their normals onto the quadrics of the points, and the noise."""
    from scipy.spatial import cKDTree

    cloud = _as_cloud(points, normals.astype(np.float64), blur, threads)
    apart = (
        np.sqrt(np.pi / NEIGHBOURS)
        * cKDTree(points).query(vertices, NEIGHBOURS, workers=threads)[0][:, -1]
    )
    # Noise takes points off the surface, and so away from each other.
    area = float(triangle_areas(vertices, triangles).sum())
    apart *= min(1.0, float(np.sqrt(area / len(points)) / np.median(apart)))
    averages, before = _averages(triangles), vertices
    for number in range(FIT_ROUNDS):
        facing = vertex_normals(vertices, triangles)
        fits = cloud.fits(vertices, facing, blur, apart)
        if number == 0 and not known:
            blur = UNDER * float(np.median(fits.residual))
        steps = round(SMOOTHING * min(1.0, blur / edge))
        bound = BOUND / max(blur, np.finfo(float).tiny)
        bend = _smoothed(np.clip(fits.bend, -bound, bound), averages, steps)
        # Noise carries points of a bent surface to its hollow side (half the variance times the
        # Laplacian of the height).
        height = _smoothed(fits.height, averages, steps // 2) - blur**2 * bend
        height = np.clip(height, -2 * edge, 2 * edge) * (fits.weight > TOO_FEW)
        vertices = vertices + height[:, None] * facing
        if steps:
            aside = 0.5 * (averages @ vertices - vertices)
            facing = vertex_normals(vertices, triangles)
            vertices = vertices + aside - (aside * facing).sum(axis=1, keepdims=True) * facing
    if not steps:  # what is smoothed does not fold
        vertices = _unfolded(before, vertices, triangles)
    return vertices, blur


def _unfolded(before: Floats, after: Floats, triangles: Ints) -> Floats:
    """The vertices ``after (V, 3)``, those of triangles that have turned over since ``before`` put
    back."""
    normals, _ = triangle_normals(before, triangles)
    after = after.copy()
    for _ in range(UNFOLDINGS):
        turned = np.einsum("ij,ij->i", triangle_normals(after, triangles)[0], normals) < TURNED
        if not turned.any():
            break
        back = np.unique(triangles[turned])
        after[back] = before[back]
    return after


def _averages(triangles: Ints) -> Any:
    """The sparse matrix of means over neighbours."""
    from scipy.sparse import csr_array, diags_array

    start = triangles.reshape(-1)
    end = triangles[:, [1, 2, 0]].reshape(-1)
    matrix = csr_array((np.ones(len(start)), (start, end)))
    return diags_array(1 / np.maximum(matrix.sum(axis=1), 1)) @ matrix


def _smoothed(values: Floats, averages: Any, steps: int) -> Floats:
    for _ in range(steps):
        values = 0.5 * (values + averages @ values)
    return values


def _as_cloud(points: Floats, normals: Floats, blur: float, threads: int) -> Cloud:
    """The points with their normals, those within a small part of the noise as one."""
    if FIT_CELL * blur < typical(spacings(points, threads)):
        return Cloud(points, normals, np.ones(len(points)), threads)
    at, weights, group = thinned(points, FIT_CELL * blur)
    mean = _sums(group, normals)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), np.finfo(float).tiny)
    return Cloud(at, mean, weights, threads)
