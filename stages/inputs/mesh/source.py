"""Triangles as a source: inside by winding number, the generalised one where they are open."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...formats import packed
from ...formats.mesh_file import load
from ...mesh import geometry
from ...mesh.graph import components
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.queries.parity import RayParity
from ...mesh.queries.winding import WindingNumber, winding_number
from ...mesh.topology import bad_edges, edges, split_pinched, topology
from .caps import capped
from .repair_child import repaired
from .sheet import thickened
from .united import Union, parted, united, without_walls

ROUNDING = 1e-6
"""In cells."""
LEVEL = 0.5
"""Winding number from which a point is inside an open mesh."""
ULPS = 4.0
"""Roundings of single precision, at the size of the coordinates, within which vertices are one."""
SHEET = 0.5
"""Sureness below which a mesh is taken as a sheet."""
SOUP, SURE = 0.5, 0.9
"""Share of the edges that are open, and sureness, beyond which a mesh is no surface of a solid."""
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


class TriangleSource(ABC):
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

    def median_edge_length(self) -> float:
        """``h_ref`` of the paper's curvature metric: over the polygon edges as found."""
        ends: Ints = edges(self.joined)
        at = self.joined.vertices[ends]
        return float(np.median(np.linalg.norm(at[:, 0] - at[:, 1], axis=1)))

    def topology(self) -> tuple[int, int] | None:
        """Of a closed mesh: a vertex where several fans of faces meet counts once for each."""
        if self.open_edges:
            return None
        facts = topology(self.welded)
        return facts.euler_number + facts.pinched_vertices, facts.components

    def manifold(self) -> PolygonMesh:
        """The triangles with a vertex of its own for every fan of a pinched one."""
        return split_pinched(PolygonMesh.of_triangles(self.vertices, self.triangles))


class MeshSource(TriangleSource):
    """A surface mesh from a file; opens it once and keeps it as it is."""

    kind = "mesh"

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, packed.stem(path)
        self.loaded = load(path)
        self.repair = False
        self.thickness = 0.0

    @cached_property
    def polygons(self) -> PolygonMesh:
        if self.thickness:
            return thickened(self._sound, self.thickness, str(self.path))
        return self._sound

    @cached_property
    def _sound(self) -> PolygonMesh:
        """As found, or repaired."""
        if self.repair:
            return repaired(self.loaded.polygons, str(self.path))
        return self.loaded.polygons

    @property
    def flat(self) -> bool:
        """Whether it has no extent along an axis."""
        return bool(np.count_nonzero(np.ptp(self.loaded.polygons.vertices, axis=0)) < 3)

    def take_as_sheet(self, thickness: float) -> None:
        """From now on, unless ``thickness`` is 0: the surface around all that is so near to it."""
        self.thickness = thickness
        if not thickness:
            return
        for name in (
            "polygons", "joined", "parted", "capped", "unwalled", "closed", "united", "_fanned",
            "open_edges", "_rays", "winding", "sureness",
        ):  # fmt: skip
            self.__dict__.pop(name, None)

    def refuse_soup(self) -> None:
        """Raise InputError where most edges are open and much of the inside is in doubt."""
        count = len(edges(self.welded)) if self.open_edges else 0
        if self.open_edges > SOUP * count and self.sureness < SURE:
            raise InputError(
                f"{self.path}: {self.open_edges} of {count} edges are not in two "
                f"faces, and the inside is certain in {100 * self.sureness:.0f} % of "
                "it only, so the mesh is not the surface of a solid; weld its "
                "vertices with --weld DISTANCE, use them as points with --kind "
                "points, or continue with --allow-poor-input"
            )

    def describe(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "name": self.name,
            "vertices": self.polygons.vertex_count,
            "faces": self.polygons.face_count,
            "polygons_kept": self.loaded.polygons_kept and not (self.repair or self.thickness),
            "repaired": self.repair,
            "thickness": self.thickness,
            "open_edges": len(bad_edges(welded(self.loaded.polygons, self.reach))),
            "doubled_faces": self.winding.doubled if self.open_edges else 0,
            "turned_faces": self.winding.turned if self.open_edges else 0,
            "welded_vertices": self.polygons.vertex_count - self.joined.vertex_count,
            "capped_openings": 0 if self.capped is None else self.capped[1],
            "walls": 0 if self.unwalled is None else self.unwalled[1],
            **(self.united or Union(None)).facts(),
            "sureness": round(self.sureness, 4),
        }

    def state(self) -> dict[str, Any]:
        asked = self.repair or self.thickness or self.hollow or self.reach is not None
        if self.welded is self.joined and not asked:
            return {"source/whole": np.bool_(self.open_edges == 0)}
        return {"source/vertices": self.vertices, "source/triangles": self.triangles}

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Take what ``state`` was, of the same mesh."""
        if "source/vertices" in stored:
            mesh = PolygonMesh.of_triangles(stored["source/vertices"], stored["source/triangles"])
            self.__dict__ |= {"polygons": mesh, "joined": mesh, "closed": mesh, "united": None}
        elif stored.get("source/whole"):
            self.__dict__["united"] = None

    def warnings(self) -> list[str]:
        said = []
        if self.repair:
            before, after = self.loaded.polygons, self._sound
            said.append(
                f"the mesh was repaired: of {before.face_count} faces and "
                f"{len(bad_edges(welded(before)))} edges not in two faces, "
                f"{after.face_count} faces and {len(bad_edges(welded(after)))} such "
                "edges are left"
            )
        if self.thickness:
            edges_found = len(bad_edges(welded(self._sound)))
            said.append(
                f"the mesh ({edges_found} edges are not in two faces) is made a sheet "
                f"{self.thickness:g} thick; for a solid, close it or use --repair; "
                "--thickness sets the thickness"
            )
        return said + self.taken() + self._open_warnings()

    def taken(self) -> list[str]:
        """What is taken otherwise than it is in the file."""
        said = []
        if self.parted is not None:
            said.append(
                f"parts of the mesh touch each other: {self.parted[1]} of its "
                f"{len(self.joined.face_offsets) - 1} faces, which are doubled or lie "
                "between two parts, are left out, and edges of more than two faces "
                "are split"
            )
        if self.capped is not None:
            openings = self.capped[1]
            said.append(
                f"the mesh has {openings} opening{'s' if openings > 1 else ''} with a "
                "flat edge: flat caps close the surface there"
            )
        if self.unwalled is not None:
            said.append(
                f"{self.unwalled[1]} faces of the mesh are walls between chambers "
                "inside: they are left out, and the space around them is solid"
            )
        if self.united is not None:
            said += self.united.warnings(self.hollow)
        return said

    def _open_warnings(self) -> list[str]:
        if self.open_edges == 0:
            return []
        taken = [
            f"{count} {what}"
            for count, what in (
                (self.winding.doubled, "doubled faces count once"),
                (self.winding.turned, "turned faces are turned back"),
            )
            if count
        ]
        return [
            (
                f"the mesh is not closed ({self.open_edges} edges are not in two faces): "
                f"inside is where the winding number is above {LEVEL:g}, which is certain "
                f"in {100 * self.sureness:.1f} % of it"
            )
            + "".join(f"; {what}" for what in taken)
        ]
