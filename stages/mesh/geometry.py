"""Areas, normals, centroids and samples of polygon meshes, with numpy.

``frames`` computes areas, normals and centroids with gradients.
"""

from __future__ import annotations

import numpy as np

from .polygons import Floats, Ints, PolygonMesh


def face_sums(mesh: PolygonMesh, corner_values: Floats) -> Floats:
    """The sum ``(F, ...)`` over each face of ``corner_values (sum, ...)`` at its corners."""
    sums = np.zeros((mesh.face_count, *corner_values.shape[1:]))
    occupied = np.flatnonzero(mesh.valences > 0)
    if len(occupied):
        sums[occupied] = np.add.reduceat(corner_values, mesh.face_offsets[occupied], axis=0)
    return sums


def face_frames(mesh: PolygonMesh) -> tuple[Floats, Floats, Floats]:
    """Area ``(F,)``, unit normal ``(F, 3)`` and area centroid ``(F, 3)`` of each face.

    Each face is divided into a fan of triangles about the mean of its corners. The vector area does
    not depend on that point. The centroid weighs each triangle by its area along the face normal,
    so that clusters of nearly equal vertices do not pull it. A face without area gets the mean of
    its corners and a zero normal.
    """
    corners = mesh.vertices[mesh.face_vertices]
    apex = face_sums(mesh, corners) / np.maximum(mesh.valences, 1)[:, None]
    at = apex[mesh.corner_faces]
    following = mesh.vertices[mesh.next_vertices]
    fans = 0.5 * np.cross(corners - at, following - at)
    vector_area = face_sums(mesh, fans)
    area = np.linalg.norm(vector_area, axis=1)
    solid = area > 0
    normal = np.zeros_like(vector_area)
    normal[solid] = vector_area[solid] / area[solid, None]
    weight = np.einsum("ij,ij->i", fans, normal[mesh.corner_faces])
    offset = face_sums(mesh, weight[:, None] * (corners + following - 2 * at)) / 3
    centroid = apex.copy()
    centroid[solid] += offset[solid] / area[solid, None]
    return area, normal, centroid


def fan_triangles(mesh: PolygonMesh) -> tuple[Floats, Ints, Ints]:
    """Triangles of all faces: ``(vertices, triangles (T, 3), face of each triangle (T,))``.

    Triangles stay as they are. Larger faces become fans about their centroids, which are appended
    to the vertices (the paper's triangle-face relaxation, section 3.3).
    """
    _, _, centroid = face_frames(mesh)
    large = mesh.valences > 3
    index = np.full(mesh.face_count, -1, dtype=np.int64)
    index[large] = mesh.vertex_count + np.arange(large.sum())
    corner_large = large[mesh.corner_faces]
    fans = np.stack([index[mesh.corner_faces], mesh.face_vertices, mesh.next_vertices], axis=1)[
        corner_large
    ]
    small = mesh.valences == 3
    starts = mesh.face_offsets[:-1][small]
    plain = mesh.face_vertices[starts[:, None] + np.arange(3)]
    triangles = np.concatenate([plain, fans])
    faces = np.concatenate([np.flatnonzero(small), mesh.corner_faces[corner_large]])
    order = np.argsort(faces, kind="stable")
    vertices = np.concatenate([mesh.vertices, centroid[large]])
    return vertices, triangles[order], faces[order]


def triangle_normals(vertices: Floats, triangles: Ints) -> tuple[Floats, Floats]:
    """Unit normals ``(T, 3)`` and areas ``(T,)``. A triangle without area has a zero normal."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(size, np.finfo(float).tiny)[:, None], 0.5 * size


def triangle_areas(vertices: Floats, triangles: Ints) -> Floats:
    """Areas ``(T,)`` of the triangles."""
    return triangle_normals(vertices, triangles)[1]


def enclosed_volume(vertices: Floats, triangles: Ints) -> float:
    """The signed volume inside a closed triangle surface, positive if its normals point outward."""
    origin = vertices.mean(axis=0)
    a, b, c = (vertices[triangles[:, k]] - origin for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def component_volumes(mesh: PolygonMesh, component: Ints, count: int) -> Floats:
    """The signed volume ``(count,)`` inside each component, negative for a cavity.

    ``component (F,)`` is the component of each face.
    """
    area, normal, centroid = face_frames(mesh)
    height = np.einsum("ij,ij->i", centroid - mesh.vertices.mean(axis=0), normal)
    return np.asarray(np.bincount(component, area * height / 3, minlength=count), np.float64)


def sample_triangles(
    vertices: Floats, triangles: Ints, count: int, random: np.random.Generator
) -> tuple[Floats, Ints]:
    """``count`` random points ``(count, 3)``, uniform by area, and their triangles ``(count,)``."""
    cumulative = np.cumsum(triangle_areas(vertices, triangles))
    chosen = np.searchsorted(cumulative, random.random(count) * cumulative[-1], side="right")
    chosen = np.minimum(chosen, len(triangles) - 1)
    u, v = random.random(count), random.random(count)
    root = np.sqrt(u)[:, None]
    a, b, c = (vertices[triangles[chosen, k]] for k in range(3))
    return (1 - root) * a + root * (1 - v[:, None]) * b + root * v[:, None] * c, chosen


def vertex_normals(vertices: Floats, triangles: Ints) -> Floats:
    """Unit vertex normals ``(V, 3)``: the area-weighted mean of the triangles'
    normals (appendix B.2)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for axis in range(3):
        total[:, axis] = np.bincount(
            triangles.reshape(-1), np.repeat(cross[:, axis], 3), minlength=len(vertices)
        )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1)


def limited(vectors: Floats, most: Floats | float) -> Floats:
    """``vectors (N, 3)``, of which those longer than ``most`` are shortened to it."""
    size = np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
    return np.asarray(vectors * np.minimum(1.0, most / size)[:, None])
