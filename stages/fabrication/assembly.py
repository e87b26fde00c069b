"""The union of many bodies as one printable mesh, with coordinates that 32
bits represent exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.polygons import Ints

Floats32 = NDArray[np.float32]

GRID = 2.0**-12
"""Grid of the coordinates in mm.

Every file format can represent its multiples: 32 bits hold them up to 4 m. lib3mf rounds decimals
slightly, and GLB is in metres.
"""
AT_ONCE = 200
"""Number of bodies that are united in one operation."""


@dataclass(frozen=True)
class Part:
    """The printed body, and the parts that were left out of it."""

    vertices: Floats32
    triangles: Ints
    volume: float
    genus: int
    dropped_parts: int
    dropped_volume: float
    filled_volume: float
    """Volume of the closed voids that were filled, in mm^3."""


def largest(body: Any) -> Part:
    """The largest part of ``body``, as it is written.

    Raises NumericalFailure if the boolean operations failed.
    """
    if body.status().name != "NoError" or body.is_empty():
        raise NumericalFailure(
            f"the union of the tubes failed ({body.status().name}); change --tube-diameter or "
            "--merge a little"
        )
    # A closed void is a part of negative volume. Leaving it out fills the void.
    pieces = [(part, part.volume()) for part in body.decompose()]
    parts = [part for part, _ in sorted(pieces, key=lambda piece: -piece[1]) if part.volume() > 0]
    mesh = parts[0].to_mesh64()
    vertices, triangles = _weld(
        np.asarray(mesh.vert_properties[:, :3]), np.asarray(mesh.tri_verts, dtype=np.int64)
    )
    return Part(
        vertices=vertices,
        triangles=triangles,
        volume=float(parts[0].volume()),
        genus=int(parts[0].genus()),
        dropped_parts=len(parts) - 1,
        dropped_volume=float(sum(part.volume() for part in parts[1:])),
        filled_volume=-float(sum(volume for _, volume in pieces if volume < 0)),
    )


def handles(body: Any) -> int:
    """Sum of the genera of the parts of ``body``."""
    return int(body.genus()) + len(body.decompose()) - 1


def union(bodies: list[Any]) -> Any:
    """The union of ``bodies``, neighbours first, so that early unions are small and hidden
    surface is removed early."""
    from manifold3d import Manifold, OpType

    boxes = np.array([body.bounding_box() for body in bodies]).reshape(-1, 2, 3)
    middle = boxes.mean(axis=1)

    def united(which: Ints) -> Any:
        if len(which) <= AT_ONCE:
            body = Manifold.batch_boolean([bodies[i] for i in which], OpType.Add)
        else:
            axis = np.ptp(middle[which], axis=0).argmax()
            ordered = which[np.argsort(middle[which, axis], kind="stable")]
            half = len(which) // 2
            body = united(ordered[:half]) + united(ordered[half:])
        # manifold3d delays operations; asking for the status makes it compute this one now.
        body.status()
        return body

    return united(np.arange(len(bodies)))


def snapped(vertices: NDArray[np.float64]) -> Floats32:
    """Coordinates rounded to GRID."""
    return np.asarray(np.round(vertices / GRID) * GRID, dtype=np.float32)


def _weld(vertices: NDArray[np.float64], triangles: Ints) -> tuple[Floats32, Ints]:
    """Round to GRID, merge equal vertices, and remove triangles that collapse.

    Two triangles over the same three vertices in opposite directions enclose nothing and are
    removed too.
    """
    places, index = np.unique(snapped(vertices), axis=0, return_inverse=True)
    triangles = index.reshape(-1)[triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    order = np.argsort(triangles, axis=1)
    ordered = np.take_along_axis(triangles, order, axis=1)
    even = np.isin(order @ np.array([9, 3, 1]), [0 * 9 + 1 * 3 + 2, 1 * 9 + 2 * 3, 2 * 9 + 1])
    _, group = np.unique(ordered, axis=0, return_inverse=True)
    balance = np.bincount(group.reshape(-1), np.where(even, 1, -1))
    size = np.bincount(group.reshape(-1))
    paired = ((size == 2) & (balance == 0))[group.reshape(-1)]
    triangles = triangles[~paired]
    used = np.unique(triangles)
    renumber = np.zeros(len(places), dtype=np.int64)
    renumber[used] = np.arange(len(used))
    return places[used], renumber[triangles]
