"""STL: triangles in binary form, in millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Ints


def encode(vertices: NDArray[np.float32], triangles: Ints) -> bytes:
    """A binary STL of ``vertices (V, 3) float32`` and ``triangles (T, 3)``."""
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    record = np.zeros(
        len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("pad", "<u2")]
    )
    record["normal"] = normal / np.where(length > 0, length, 1)
    record["corners"] = corners
    header = b"vorolight, millimetres".ljust(80, b" ")
    return header + np.uint32(len(triangles)).tobytes() + record.tobytes()
