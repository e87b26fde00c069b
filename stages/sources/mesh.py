"""A mesh as a source: inside by winding number, by ray parity where it is open."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface import geometry
from ..surface.polygons import Floats, Ints, PolygonMesh
from ..surface.topology import bad_edges, edges, split_pinched, topology
from .mesh_file import load
from .parity import RayParity

ROUNDING = 1e-6
"""In cells."""


class MeshSource:
    """A surface mesh from a file; opens it once and keeps it as it is."""

    kind = "mesh"

    def __init__(self, path: Path) -> None:
        loaded = load(path)
        self.path = path
        self.name = path.stem
        self.polygons = loaded.polygons
        self.polygons_kept = loaded.polygons_kept
        # Equal positions are one vertex here, so that neighbours share edges; the file as found
        # stays in ``polygons``.
        self.vertices, self.triangles, _ = geometry.fan_triangles(self._welded)

    def bounding_box(self) -> Floats:
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def open_edges(self) -> int:
        """Edges not in two faces with opposite directions, vertices at one place taken as one."""
        return len(bad_edges(self._welded))

    @cached_property
    def _welded(self) -> PolygonMesh:
        places, same = np.unique(self.polygons.vertices, axis=0, return_inverse=True)
        return PolygonMesh(
            places,
            self.polygons.face_offsets,
            same.reshape(-1)[self.polygons.face_vertices].astype(np.int64),
        )

    @cached_property
    def _rays(self) -> list[RayParity]:
        directions = (0,) if self.open_edges == 0 else (0, 1, 2)
        return [RayParity(self.vertices, self.triangles, d) for d in directions]

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """The winding number is not zero; on an open mesh, where there is none, the majority of
        three rays' parities."""
        if self.open_edges == 0:
            return np.asarray(self._rays[0].winding(points) != 0)
        votes = np.sum([rays.inside(points) for rays in self._rays], axis=0)
        return np.asarray(votes * 2 > len(self._rays))

    def may_cross(self, origin: Floats, edge: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The cells that meet the box of a triangle; all if the mesh is open, as the inside then
        ends anywhere."""
        if self.open_edges:
            return np.ones(shape, dtype=bool)
        corners = (self.vertices[self.triangles] - origin) / edge
        # A little more on every side: rounding must not lose a cell.
        low, high = corners.min(axis=1) - ROUNDING, corners.max(axis=1) + ROUNDING
        first = np.maximum(np.floor(low).astype(np.int64), 0)
        last = np.minimum(np.floor(high).astype(np.int64) + 1, shape)
        count = np.zeros(np.add(shape, 1), dtype=np.int64)
        whole = (first < last).all(axis=1)
        # Corners of the boxes, with signs, add up to how many boxes a cell is in.
        for corner in np.ndindex(2, 2, 2):
            at = np.where(np.array(corner, dtype=bool), last[whole], first[whole])
            np.add.at(count, tuple(at.T), (-1) ** sum(corner))
        for axis in range(3):
            np.cumsum(count, axis=axis, out=count)
        return np.asarray(count[:-1, :-1, :-1] > 0)

    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        return geometry.sample_triangles(self.vertices, self.triangles, count, random)[0]

    def median_edge_length(self) -> float:
        """``h_ref`` of the paper's curvature metric: over the polygon edges as found."""
        ends: Ints = edges(self._welded)
        at = self._welded.vertices[ends]
        return float(np.median(np.linalg.norm(at[:, 0] - at[:, 1], axis=1)))

    def topology(self) -> tuple[int, int] | None:
        """Of a closed mesh: a vertex where several fans of faces meet counts once for each."""
        if self.open_edges:
            return None
        facts = topology(self._welded)
        return facts.euler_number + facts.pinched_vertices, facts.components

    def manifold(self) -> PolygonMesh:
        """The triangles with a vertex of its own for every fan of a pinched one."""
        return split_pinched(PolygonMesh.of_triangles(self.vertices, self.triangles))

    def describe(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "name": self.name,
            "vertices": self.polygons.vertex_count,
            "faces": self.polygons.face_count,
            "polygons_kept": self.polygons_kept,
            "open_edges": self.open_edges,
        }

    def warnings(self) -> list[str]:
        if self.open_edges == 0:
            return []
        return [
            f"the mesh is not closed ({self.open_edges} bad edges): inside is the majority of "
            "three rays and may be wrong near the holes"
        ]
