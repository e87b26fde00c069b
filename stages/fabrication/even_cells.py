"""Cells of one size on a surface, whatever the size of its own faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.dual import dual
from ..mesh.edge_table import Sized
from ..mesh.geometry import fan_triangles
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.queries.projection import ClosestPoint
from ..remesh.remeshing import divide, remesh, thin_out

SHEET = 0.15
"""Distance, in cell sizes, that counts like a difference of 1 between normals when opposite
sheets are told apart."""
SAMPLES = 10_000


class _Itself:
    """The surface to which the new triangles are fitted, in units of the cell size."""

    def __init__(self, vertices: Floats, triangles: NDArray[np.int64], threads: int) -> None:
        self._closest = ClosestPoint(vertices, triangles, SHEET, threads)
        step = max(1, len(self._closest.samples) // SAMPLES)
        self.samples = self._closest.samples[::step]
        self.normals = self._closest.sample_normals[::step]

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        return self._closest(points, normals)


def even_cells(surface: PolygonMesh, size: float, threads: int) -> PolygonMesh:
    """Polygons of about ``size`` on ``surface``, three of which meet at every corner.

    They are the dual of triangles with edges of ``size``, in the unit of the surface. Raises
    ValueError if the surface is not closed.
    """
    vertices, triangles, _ = fan_triangles(surface)
    middle = vertices.mean(axis=0)
    vertices = (vertices - middle) / size
    target = _Itself(vertices, triangles, threads)
    mesh = Sized(vertices, triangles, np.ones(len(vertices)))

    def length(points: Floats) -> Floats:
        return np.ones(len(points))

    thin_out(mesh, length)
    divide(mesh, length, target)
    remesh(mesh, length, target)
    found = dual(PolygonMesh.of_triangles(mesh.vertices, mesh.triangles))
    return found.with_vertices(middle + size * found.vertices)
