"""Triangles as a source: inside by winding number, the generalised one where they are open."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...mesh import geometry
from ...mesh.creases import Chain
from ...mesh.graph import components
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.queries.parity import RayParity
from ...mesh.queries.true_surface import TrueSurface
from ...mesh.queries.winding import WindingNumber, winding_number
from ...mesh.topology import bad_edges, split_pinched, topology
from ..creases.combined import combined
from ..source import Source
from .caps import capped
from .true_surface import LEVEL, MeshSurface
from .united import Union, parted, united, without_walls

ROUNDING = 1e-6
"""In cells."""
ULPS = 4.0
"""Roundings of single precision, at the size of the coordinates, within which vertices are one."""
UNSURE = 0.25
"""What is nearer to LEVEL than this may be inside or not."""
SAMPLES = 20_000
"""Points that are asked how sure they are."""


def welded(mesh: PolygonMesh, reach: float | None = None) -> PolygonMesh:
    """``mesh`` with one vertex at every place, so that neighbours share edges; vertices of open
    edges within ``reach`` of each other are one too, if more edges are closed then. By default
    that is as near as single precision tells."""
    places, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    exact = PolygonMesh(
        places, mesh.face_offsets, same.reshape(-1)[mesh.face_vertices].astype(np.int64)
    )
    loose = np.unique(bad_edges(exact))
    if len(loose) == 0:
        return exact
    if reach is None:
        reach = ULPS * float(np.finfo(np.float32).eps) * float(np.abs(exact.vertices).max())
    nearly = _joined(exact, loose, reach)
    return nearly if len(bad_edges(nearly)) < len(bad_edges(exact)) else exact


def _joined(mesh: PolygonMesh, loose: Ints, reach: float) -> PolygonMesh:
    """``mesh`` with those vertices ``loose (L,)`` that are within ``reach`` of each other as one;
    faces that have no area then are left out."""
    from scipy.spatial import cKDTree

    at = mesh.vertices[loose]
    pairs = cKDTree(at).query_pairs(reach, output_type="ndarray")
    _, group = components(len(loose), pairs)
    _, first = np.unique(group, return_index=True)
    number = np.arange(mesh.vertex_count)
    number[loose] = loose[first[group]]
    corners = number[mesh.face_vertices]
    # Repeated corners go, and faces of fewer than three.
    kept = corners != corners[mesh.next_corners]
    count = np.bincount(mesh.corner_faces[kept], minlength=mesh.face_count)
    kept &= count[mesh.corner_faces] >= 3
    count = count[count >= 3]
    offsets = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return PolygonMesh(mesh.vertices, offsets, corners[kept]).without_unused_vertices()


class TriangleSource(Source):
    """The surface of ``polygons``, which stay as they are."""

    reach: float | None = None
    """Distance within which vertices of open edges are one; None: as single precision tells."""
    hollow = False
    """Whether of closed parts within each other each second one is a cavity."""

    @property
    @abstractmethod
    def polygons(self) -> PolygonMesh:
        """As found, or as made."""

    @property
    def vertices(self) -> Floats:
        """Of the triangles, ``(V, 3)``."""
        return self._fanned[0]

    @property
    def triangles(self) -> Ints:
        return self._fanned[1]

    @cached_property
    def _fanned(self) -> tuple[Floats, Ints]:
        return geometry.fan_triangles(self.welded)[:2]

    def triangulated(self) -> tuple[Floats, Ints]:
        return self._fanned

    def bounding_box(self) -> Floats:
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def open_edges(self) -> int:
        """Edges not in two faces with opposite directions, vertices at one place taken as one."""
        return len(bad_edges(self.welded))

    @cached_property
    def united(self) -> Union | None:
        """The union of closed parts that cross themselves, each other or hold each other, if there
        are any."""
        return None if len(bad_edges(self.closed)) else united(self.closed, self.hollow)

    @property
    def welded(self) -> PolygonMesh:
        """The polygons with one vertex at every place, and the surface of their union where closed
        parts cross each other."""
        found = None if self.united is None else self.united.mesh
        return self.closed if found is None else found

    @cached_property
    def closed(self) -> PolygonMesh:
        """The polygons with one vertex at every place, parts that touch taken apart, flat openings
        closed, and walls inside left out."""
        better = self.parted or self.capped or self.unwalled
        return self.joined if better is None else better[0]

    @cached_property
    def parted(self) -> tuple[PolygonMesh, int] | None:
        """The triangles where only parts that touch keep a mesh from being closed, and how many
        faces are left out."""
        return parted(self.joined) if len(bad_edges(self.joined)) else None

    @cached_property
    def capped(self) -> tuple[PolygonMesh, int] | None:
        """The triangles of an open mesh with flat caps over its openings, and their number."""
        open_otherwise = self.parted is None and len(bad_edges(self.joined))
        return capped(self.joined) if open_otherwise else None

    @cached_property
    def unwalled(self) -> tuple[PolygonMesh, int] | None:
        """The triangles without walls between chambers, and how many these are."""
        open_otherwise = self.parted is None and len(bad_edges(self.joined))
        return without_walls(self.joined) if open_otherwise else None

    @cached_property
    def joined(self) -> PolygonMesh:
        """The polygons with one vertex at every place."""
        return welded(self.polygons, self.reach)

    @cached_property
    def _rays(self) -> RayParity:
        return RayParity(self.vertices, self.triangles)

    @cached_property
    def winding(self) -> WindingNumber:
        """Of an open mesh."""
        rays = [RayParity(self.vertices, self.triangles, direction) for direction in range(3)]
        return winding_number(self.vertices, self.triangles, rays)

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """The winding number is not zero; on an open mesh, where it is no integer, it is more than
        a half."""
        if self.open_edges == 0:
            return np.asarray(self._rays.winding(points) != 0)
        return np.asarray(self.winding(points) > LEVEL)

    def may_cross(self, origin: Floats, edge: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The cells that meet the box of a triangle; of an open mesh also those beside them, and
        those whose winding number is near a half."""
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
        met = count[:-1, :-1, :-1] > 0
        if self.open_edges == 0:
            return np.asarray(met)
        from scipy.ndimage import binary_dilation

        centres = origin + edge * (np.argwhere(np.ones(shape, dtype=bool)) + 0.5)
        near = np.abs(self.winding(centres) - LEVEL).reshape(shape) < UNSURE
        return np.asarray(binary_dilation(met, np.ones((3, 3, 3))) | near)

    @cached_property
    def sureness(self) -> float:
        """Share of the inside, within the bounding box, that is so without doubt."""
        if self.open_edges == 0:
            return 1.0
        low, high = self.bounding_box()
        points = low + np.random.default_rng(0).random((SAMPLES, 3)) * (high - low)
        above = self.winding(points) - LEVEL
        return float((above > UNSURE).sum() / max(1, (above > 0).sum()))

    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        return geometry.sample_triangles(self.vertices, self.triangles, count, random)[0]

    def topology(self) -> tuple[int, int] | None:
        """Of a closed mesh: a vertex where several fans of faces meet counts once for each."""
        if self.open_edges:
            return None
        facts = topology(self.welded)
        return facts.euler_number + facts.pinched_vertices, facts.components

    def manifold(self) -> PolygonMesh:
        """The triangles with a vertex of its own for every fan of a pinched one."""
        return split_pinched(PolygonMesh.of_triangles(self.vertices, self.triangles))

    def true_surface(self, frame: ModelFrame, threads: int) -> TrueSurface:
        """The surface in model units."""
        return MeshSurface(self, frame, threads)

    def exact_creases(self, frame: ModelFrame, angle: float) -> list[Chain]:
        """None: the edges of these triangles are not those of the shape."""
        return []

    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """Exact ones and rounded ones."""
        return self._creases(surface, frame, angle, exact=True)

    def _creases(
        self, surface: TrueSurface, frame: ModelFrame, angle: float, exact: bool
    ) -> list[Chain]:
        box = frame.model_from_input(np.asarray(self.bounding_box(), dtype=float))
        return combined(self.exact_creases(frame, angle), surface, box, angle, exact)
