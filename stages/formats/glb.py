"""GLB: triangles with colours at their vertices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints


def encode(vertices: Floats, triangles: Ints, colours: NDArray[np.uint8]) -> bytes:
    """The GLB bytes of a surface; ``colours (V, 3)`` are red, green and blue."""
    import trimesh

    opaque = np.column_stack([colours, np.full(len(colours), 255, np.uint8)])
    mesh = trimesh.Trimesh(vertices, triangles, vertex_colors=opaque, process=False)
    data: Any = mesh.export(file_type="glb")
    return bytes(data)
