"""The polygon mesh: flat arrays, with the faces in compressed-row form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ARRAYS = ("vertices", "face_offsets", "face_vertices")
"""The names of a mesh's arrays, in HDF5 files as in memory."""


@dataclass(frozen=True)
class PolygonMesh:
    """A surface of polygons with shared vertices.

    ``vertices`` is ``(V, 3) float64``. The corners of face ``f`` are
    ``face_vertices[face_offsets[f]:face_offsets[f + 1]]``, counter-clockwise seen from outside.
    """

    vertices: Floats
    face_offsets: Ints
    face_vertices: Ints

    @classmethod
    def of_triangles(cls, vertices: Floats, triangles: Ints) -> PolygonMesh:
        """A mesh whose faces all have as many corners as ``triangles`` has columns."""
        faces = np.asarray(triangles, dtype=np.int64)
        offsets = np.arange(len(faces) + 1, dtype=np.int64) * faces.shape[1]
        return cls(np.asarray(vertices, dtype=np.float64), offsets, faces.reshape(-1))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], prefix: str = "") -> PolygonMesh:
        """The mesh that ``as_arrays`` stored under ``prefix``."""
        return cls(*(arrays[prefix + name] for name in ARRAYS))

    def as_arrays(self, prefix: str = "") -> dict[str, Any]:
        """The arrays of the mesh by name, each name with ``prefix`` before it."""
        return {prefix + name: getattr(self, name) for name in ARRAYS}

    @property
    def face_count(self) -> int:
        return len(self.face_offsets) - 1

    @property
    def vertex_count(self) -> int:
        return len(self.vertices)

    @cached_property
    def valences(self) -> Ints:
        """The number of corners of each face, ``(F,)``."""
        return np.diff(self.face_offsets)

    @cached_property
    def corner_faces(self) -> Ints:
        """The face of each corner, ``(sum,)``."""
        return np.repeat(np.arange(self.face_count, dtype=np.int64), self.valences)

    @cached_property
    def next_corners(self) -> Ints:
        """The corner that follows each corner in its ring, ``(sum,)``."""
        following = np.arange(1, len(self.face_vertices) + 1, dtype=np.int64)
        nonempty = self.valences > 0
        following[self.face_offsets[1:][nonempty] - 1] = self.face_offsets[:-1][nonempty]
        return following

    @cached_property
    def next_vertices(self) -> Ints:
        """The vertex that follows each corner in its ring, ``(sum,)``."""
        return self.face_vertices[self.next_corners]

    def with_vertices(self, vertices: Floats) -> PolygonMesh:
        """The same faces with other ``vertices (V, 3)``."""
        return PolygonMesh(
            np.ascontiguousarray(vertices, dtype=np.float64), self.face_offsets, self.face_vertices
        )

    def without_unused_vertices(self) -> PolygonMesh:
        """The same faces without the vertices that no face uses. The order
        of the others is kept."""
        used = np.zeros(self.vertex_count, dtype=bool)
        used[self.face_vertices] = True
        if used.all():
            return self
        renumber = np.cumsum(used) - 1
        return PolygonMesh(self.vertices[used], self.face_offsets, renumber[self.face_vertices])

    def select_faces(self, keep: NDArray[np.bool_]) -> PolygonMesh:
        """The faces for which ``keep (F,)`` is true, with all vertices."""
        offsets = np.concatenate([[0], np.cumsum(self.valences[keep])]).astype(np.int64)
        return PolygonMesh(self.vertices, offsets, self.face_vertices[keep[self.corner_faces]])
