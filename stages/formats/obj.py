"""OBJ: triangles as text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Ints


def encode(vertices: NDArray[np.float32], triangles: Ints) -> bytes:
    """An OBJ file of ``vertices (V, 3)`` and ``triangles (T, 3)``.

    Nine digits represent 32-bit coordinates exactly.
    """
    rows = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    rows += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    return ("# vorolight, millimetres\n" + "\n".join(rows) + "\n").encode("ascii")
