"""Mean curvature by local quadric fits (paper's appendix B.2) and by dihedral angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface import geometry
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.topology import edge_keys

MINIMUM_NEIGHBOURS = 8
CONDITION_LIMIT = 1e8
"""Of the 6 x 6 normal matrix in coordinates divided by the radius; the paper gives no number."""
PAIRS_AT_ONCE = 4_000_000
MOST_NEIGHBOURS = 2000
"""More neighbours than this say that the radius does not fit the surface; no fit is made."""


@dataclass(frozen=True)
class CurvatureStatistics:
    """|H| over the valid vertices; mean and std weighted by barycentric area."""

    radius: float
    mean: float
    std: float
    median: float
    p95: float
    valid_share: float


def mean_curvature(
    vertices: Floats, triangles: Ints, radius: float, threads: int = 1
) -> tuple[Floats, NDArray[np.bool_]]:
    """``H (V,)`` from a weighted quadratic height field over the vertices within ``radius``.

    A vertex is not its own neighbour. Returns H and which vertices have a trustworthy fit: from 8
    to MOST_NEIGHBOURS neighbours and a condition number below CONDITION_LIMIT.
    """
    from scipy.spatial import cKDTree

    normals = geometry.vertex_normals(vertices, triangles)
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    tangent1 = np.cross(normals, helper)
    tangent1 /= np.maximum(np.linalg.norm(tangent1, axis=1, keepdims=True), 1e-300)
    tangent2 = np.cross(normals, tangent1)
    tree = cKDTree(vertices)
    curvature = np.zeros(len(vertices))
    valid = np.zeros(len(vertices), dtype=bool)
    expected = tree.query_ball_point(vertices, radius, workers=threads, return_length=True)
    fitted = np.flatnonzero(expected <= MOST_NEIGHBOURS + 1)
    batch = np.cumsum(expected[fitted]) // PAIRS_AT_ONCE
    for number in np.unique(batch):
        rows = fitted[batch == number]
        found = tree.query_ball_point(vertices[rows], radius, workers=threads)
        count = np.fromiter((len(row) for row in found), np.int64, len(found))
        other = np.concatenate([np.asarray(row, np.int64) for row in found])
        owner = np.repeat(np.arange(len(rows)), count)
        apart = other != rows[owner]
        owner, other = owner[apart], other[apart]
        arm = (vertices[other] - vertices[rows[owner]]) / radius
        x, y, z = (
            np.einsum("ij,ij->i", arm, frame[rows[owner]])
            for frame in (tangent1, tangent2, normals)
        )
        weight = np.exp(-(x * x + y * y + z * z) / 2)
        basis = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
        sizes = np.bincount(owner, minlength=len(rows))
        matrix = np.zeros((len(rows), 6, 6))
        right = np.zeros((len(rows), 6))
        for i in range(6):
            right[:, i] = np.bincount(owner, weight * basis[:, i] * z, minlength=len(rows))
            for j in range(i, 6):
                matrix[:, i, j] = np.bincount(
                    owner, weight * basis[:, i] * basis[:, j], minlength=len(rows)
                )
                matrix[:, j, i] = matrix[:, i, j]
        values = np.linalg.eigvalsh(matrix)
        good = (sizes >= MINIMUM_NEIGHBOURS) & (values[:, 0] * CONDITION_LIMIT > values[:, -1])
        fit = np.zeros((len(rows), 6))
        fit[good] = np.linalg.solve(matrix[good], right[good, :, None])[..., 0]
        a, b, c, fx, fy, _ = fit.T
        fxx, fxy, fyy = 2 * a, b, 2 * c
        slope = 1 + fx**2 + fy**2
        upper = (1 + fy**2) * fxx - 2 * fx * fy * fxy + (1 + fx**2) * fyy
        curvature[rows] = upper / (2 * slope**1.5) / radius
        valid[rows] = good
    return curvature, valid


def statistics(
    vertices: Floats,
    triangles: Ints,
    radius: float,
    curvature: Floats,
    valid: NDArray[np.bool_],
) -> CurvatureStatistics | None:
    """The paper's |H| statistics of ``mean_curvature``'s results; None without a valid fit."""
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


def dihedral_mean_curvature(mesh: PolygonMesh) -> float:
    """``sum |theta| L / (2 A)`` over edges in two faces: needs no radius and sees roughness."""
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
