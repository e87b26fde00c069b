"""Mean curvature by local fits of quadrics (paper, appendix B.2), and by dihedral angles."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from ..inputs.source import Source
from ..mesh import geometry
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.subdivision import subdivided
from ..mesh.topology import edge_keys

Distance = Callable[[Floats], Floats]
"""A function from points ``(N, 3)`` to their distances ``(N,)``."""

REACH = 2.0
"""The paper's rho: the radius of a fit in units of the reference's median edge length."""
MINIMUM_NEIGHBOURS = 8
CONDITION_LIMIT = 1e8
"""Largest condition number of the normal matrix ``(6, 6)``, in coordinates divided by the radius.
The paper states none."""
MOST_NEIGHBOURS = 2000
"""Largest number of neighbours of a fit. With more, the radius does not suit the surface."""
MOST_VERTICES = 600_000
"""Largest number of vertices when a surface is divided to the edge length of its reference."""


@dataclass(frozen=True)
class CurvatureStatistics:
    """Statistics of |H| over the vertices with a valid fit. Mean and std are
    weighted by barycentric area."""

    radius: float
    mean: float
    std: float
    median: float
    p95: float
    valid_share: float


def mean_curvature(
    vertices: Floats, triangles: Ints, radius: float, threads: int = 1
) -> tuple[Floats, NDArray[np.bool_]]:
    """``H (V,)`` at each vertex, from a weighted quadratic height field over vertices within
    ``radius``.

    The vertex itself is left out. The second value says which fits are valid: those with 8 to
    MOST_NEIGHBOURS neighbours and a condition number below CONDITION_LIMIT.
    """
    normals = geometry.vertex_normals(vertices, triangles)
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    tangent1 = np.cross(normals, helper)
    tangent1 /= np.maximum(np.linalg.norm(tangent1, axis=1, keepdims=True), 1e-300)
    tangent2 = np.cross(normals, tangent1)
    frames = np.stack([tangent1, tangent2, normals], axis=1)
    curvature = np.zeros(len(vertices))
    valid = np.zeros(len(vertices), dtype=bool)
    # Vertices in units of the radius are sorted by cells with edge 1; cells along z follow each
    # other.
    placed = (vertices - vertices.min(axis=0)) / radius
    cell = np.floor(placed).astype(np.int64) + 1
    shape = cell.max(axis=0) + 2
    key = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    sorted_key, sorted_place = key[order], np.ascontiguousarray(placed[order])

    def part(rows: Ints) -> tuple[Floats, Floats, Ints]:
        return _normal_equations(
            rows, placed, frames, key, shape, sorted_key, sorted_place, order, MOST_NEIGHBOURS
        )

    parts = np.array_split(np.arange(len(vertices)), max(1, threads))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        found = list(pool.map(part, parts))
    matrix, right, sizes = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    values = np.linalg.eigvalsh(matrix)
    good = (sizes >= MINIMUM_NEIGHBOURS) & (sizes <= MOST_NEIGHBOURS)
    good &= values[:, 0] * CONDITION_LIMIT > values[:, -1]
    a, b, c, fx, fy, _ = np.linalg.solve(matrix[good], right[good, :, None])[..., 0].T
    fxx, fxy, fyy = 2 * a, b, 2 * c
    slope = 1 + fx**2 + fy**2
    upper = (1 + fy**2) * fxx - 2 * fx * fy * fxy + (1 + fx**2) * fyy
    curvature[good] = upper / (2 * slope**1.5) / radius
    valid[good] = True
    return curvature, valid


@compiled
def _normal_equations(
    rows: Ints,
    placed: Floats,
    frames: Floats,
    key: Ints,
    shape: Ints,
    sorted_key: Ints,
    sorted_place: Floats,
    order: Ints,
    most: int,
) -> tuple[Floats, Floats, Ints]:
    """Matrices ``(R, 6, 6)``, right sides ``(R, 6)`` and numbers of neighbours of the fits at
    ``rows (R,)``.

    The number is ``most`` + 1 if there are more than ``most`` neighbours.
    """
    matrix = np.zeros((len(rows), 6, 6))
    right = np.zeros((len(rows), 6))
    sizes = np.zeros(len(rows), np.int64)
    basis = np.ones(6)
    for row in range(len(rows)):
        v = rows[row]
        for near in range(9):
            middle = key[v] + ((near // 3 - 1) * shape[1] + near % 3 - 1) * shape[2]
            start = np.searchsorted(sorted_key, middle - 1)
            while start < len(sorted_key) and sorted_key[start] <= middle + 1:
                dx = sorted_place[start, 0] - placed[v, 0]
                dy = sorted_place[start, 1] - placed[v, 1]
                dz = sorted_place[start, 2] - placed[v, 2]
                square = dx * dx + dy * dy + dz * dz
                start += 1
                if square > 1.0 or order[start - 1] == v:
                    continue
                sizes[row] += 1
                if sizes[row] > most:
                    break
                x = frames[v, 0, 0] * dx + frames[v, 0, 1] * dy + frames[v, 0, 2] * dz
                y = frames[v, 1, 0] * dx + frames[v, 1, 1] * dy + frames[v, 1, 2] * dz
                z = frames[v, 2, 0] * dx + frames[v, 2, 1] * dy + frames[v, 2, 2] * dz
                weight = np.exp(-square / 2)
                basis[0], basis[1], basis[2], basis[3], basis[4] = x * x, x * y, y * y, x, y
                for i in range(6):
                    right[row, i] += weight * basis[i] * z
                    for j in range(6):
                        matrix[row, i, j] += weight * basis[i] * basis[j]
            if sizes[row] > most:
                break
    return matrix, right, sizes


def statistics(
    vertices: Floats,
    triangles: Ints,
    radius: float,
    curvature: Floats,
    valid: NDArray[np.bool_],
) -> CurvatureStatistics | None:
    """The paper's statistics of |H|, from the results of ``mean_curvature``.
    None if no fit is valid."""
    if not valid.any():
        return None
    area = geometry.triangle_areas(vertices, triangles)
    share = np.bincount(triangles.reshape(-1), np.repeat(area / 3, 3), minlength=len(vertices))[
        valid
    ]
    weight = share / share.sum()
    size = np.abs(curvature[valid])
    mean = float(weight @ size)
    used = np.bincount(triangles.reshape(-1), minlength=len(vertices)) > 0
    return CurvatureStatistics(
        radius=radius,
        mean=mean,
        std=float(np.sqrt(weight @ (size - mean) ** 2)),
        median=float(np.median(size)),
        p95=float(np.percentile(size, 95)),
        valid_share=float(valid.sum() / used.sum()),
    )


def off_creases(
    vertices: Floats,
    triangles: Ints,
    radius: float,
    curvature: Floats,
    valid: NDArray[np.bool_],
    distance: Distance | None,
) -> CurvatureStatistics | None:
    """The same over those vertices whose fits reach across no crease.

    ``distance`` gives the distance of points ``(N, 3)`` from the creases of the reference. None if
    there is no such function.
    """
    if distance is None:
        return None
    clear = valid & (distance(vertices) > radius)
    return statistics(vertices, triangles, radius, curvature, clear)


def resampled(
    vertices: Floats,
    triangles: Ints,
    edge: float,
    distance: Distance | None = None,
    threads: int = 1,
) -> tuple[CurvatureStatistics | None, CurvatureStatistics | None]:
    """Statistics of |H| after a surface is divided until no edge is longer than ``edge``.

    Then every vertex has neighbours within REACH edges. Without it, the paper's metric depends on
    the density of the mesh. The two values are for all vertices and for those of ``off_creases``. A
    value is None if it takes more than MOST_VERTICES, or if no fit is valid.
    """
    fine = subdivided(vertices, triangles, edge, MOST_VERTICES)
    if fine is None:
        return None, None
    radius = REACH * edge
    fits = mean_curvature(*fine, radius, threads)
    return statistics(*fine, radius, *fits), off_creases(*fine, radius, *fits, distance)


def of_reference(
    source: Source, samples: Floats, radius: float, distance: Distance | None, threads: int = 1
) -> dict[str, dict[str, Any] | None]:
    """Statistics of |H| of the reference, which a smooth surface should reach.

    For a field they are exact at the ``samples (N, 3)``, for other inputs they come from fits.
    There are those of all vertices and those of ``off_creases``, by their names in the manifest.
    """
    names = ("reference_curvature", "reference_curvature_off_creases")
    exact = source.mean_curvature(samples)
    if exact is not None:
        size = np.abs(exact)
        clear = np.empty(0) if distance is None else size[distance(samples) > radius]
        return dict(zip(names, (_exact(size), _exact(clear)), strict=True))
    mesh = source.triangulated()
    assert mesh is not None
    fits = mean_curvature(*mesh, radius, threads)
    found = (
        statistics(*mesh, radius, *fits),
        off_creases(*mesh, radius, *fits, distance),
    )
    return {
        name: None if one is None else vars(one) | {"method": "quadric fit"}
        for name, one in zip(names, found, strict=True)
    }


def _exact(size: Floats) -> dict[str, Any] | None:
    """Statistics of exact values of |H| at samples ``(N,)``."""
    if len(size) == 0:
        return None
    return {
        "mean": float(size.mean()),
        "median": float(np.median(size)),
        "p95": float(np.percentile(size, 95)),
        "method": "analytic",
    }


def settings(edge: float, of_mesh: bool) -> dict[str, float | str]:
    """Settings of the fits, for the manifest; ``edge`` is h_ref."""
    return {
        "h_ref": edge,
        "h_ref_is": "median edge of the reference" if of_mesh else "half the voxel edge",
        "radius": REACH * edge,
        "minimum_neighbours": MINIMUM_NEIGHBOURS,
        "most_neighbours": MOST_NEIGHBOURS,
        "condition_limit": CONDITION_LIMIT,
    }


def dihedral_mean_curvature(mesh: PolygonMesh) -> float:
    """``sum |theta| L / (2 A)`` over edges in two faces. It needs no radius and is
    sensitive to roughness."""
    area, normal, _ = geometry.face_frames(mesh)
    keys, _ = edge_keys(mesh)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    left, right = order[same], order[same + 1]
    n1, n2 = normal[mesh.corner_faces[left]], normal[mesh.corner_faces[right]]
    sine = np.linalg.norm(np.cross(n1, n2), axis=1)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", n1, n2))
    ends = mesh.vertices[mesh.next_vertices[left]] - mesh.vertices[mesh.face_vertices[left]]
    return float((angle * np.linalg.norm(ends, axis=1)).sum() / (2 * area.sum()))
