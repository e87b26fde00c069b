"""The dual graph of Voronoi cells: what finite volumes with two points a face need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .geometry import face_frames
from .polygons import Floats, Ints
from .polyhedra import PolyhedralMesh

SMALL = 1e-9
"""The direction of a face with less area than this, in mean areas, is rounding only."""
PERPENDICULAR = 1e-4
"""An angle below this, in degrees, is rounding. Corners of small faces are the centres of spheres
through points that are close together."""


@dataclass(frozen=True)
class DualGraph:
    """Cells, and their connections through faces ``(F,)``: first those between two cells.

    Lengths are in the unit of the input. In a Voronoi diagram each face is perpendicular to the
    line between the generators of its cells. A flux through it is then the area times the
    difference of the values at the generators, divided by their distance, and exact for linear
    functions.
    """

    points: Floats
    """The generators of the cells, ``(C, 3)``."""
    volume: Floats
    """The volumes of the cells, ``(C,)``."""
    cells: Ints
    """The two cells of each connection ``(F, 2)``. The second is -1 on the boundary."""
    normal: Floats
    """Unit vectors ``(F, 3)`` from the first generator to the second, and out of the boundary."""
    area: Floats
    """The areas of the faces along ``normal``, ``(F,)``."""
    distance: Floats
    """The distances ``(F, 2)`` of both generators to the plane of the face; 0 for a missing one."""
    foot: Floats
    """The point ``(F, 3)`` of the face's plane on the line along ``normal`` from the first
    generator."""
    centre: Floats
    """The centroids of the faces, ``(F, 3)``."""
    tilt: Floats
    """The angle ``(F,)``, in degrees, between ``normal`` and that of the face."""

    @classmethod
    def of(cls, mesh: PolyhedralMesh, points: Floats, volume: Floats) -> DualGraph:
        """The graph of ``mesh`` with the generators ``points (C, 3)`` and ``volume (C,)``."""
        size, own, centre = face_frames(mesh.faces)
        inner = mesh.neighbour >= 0
        first, second = points[mesh.owner], points[mesh.neighbour]
        way = second - first
        normal = np.where(inner[:, None], way, own)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
        along = np.einsum("ij,ij->i", own, normal).clip(-1.0, 1.0)
        here = np.einsum("ij,ij->i", centre - first, normal)
        there = np.einsum("ij,ij->i", second - centre, normal)
        solid = size > SMALL * size.mean()
        return cls(
            points, volume, np.stack([mesh.owner, mesh.neighbour], axis=1), normal, size * along,
            np.stack([here, np.where(inner, there, 0.0)], axis=1),
            first + here[:, None] * normal, centre,
            np.where(solid, np.degrees(np.arccos(along)), 0.0),
        )  # fmt: skip

    @property
    def inner(self) -> int:
        """The number of connections between two cells."""
        return int((self.cells[:, 1] >= 0).sum())

    @property
    def remark(self) -> str:
        """A sentence on how far the faces are from perpendicular to the lines."""
        largest = float(self.tilt[: self.inner].max(initial=0.0))
        if largest < PERPENDICULAR:
            return "the lines between generators are perpendicular to the faces"
        return (
            f"the lines between generators are up to {largest:.2g} degrees from perpendicular to "
            "the faces, because short edges were contracted; run: vorolight volume --sliver 0"
        )
