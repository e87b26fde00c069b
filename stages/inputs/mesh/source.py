"""A file with a mesh as a source."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...formats import packed
from ...formats.mesh_file import load
from ...mesh.creases import Chain
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Ints, PolygonMesh
from ...mesh.topology import bad_edges, edges
from ...progress import Progress
from ..creases.sharp_edges import of_triangles
from .repair_child import repaired
from .sheet import thickened
from .triangle_source import TriangleSource, welded
from .true_surface import LEVEL
from .united import Union

SHEET = 0.5
"""Sureness below which a mesh is taken as a sheet."""
SOUP, SURE = 0.5, 0.9
"""Share of the edges that are open, and sureness, beyond which a mesh is no surface of a solid."""


class MeshSource(TriangleSource):
    """A surface mesh from a file; opens it once and keeps it as it is."""

    kind = "mesh"

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, packed.stem(path)
        self.loaded = load(path)
        self.repair = False
        self.thickness = 0.0
        self.given_thickness: float | None = None
        self.voxels = 1
        self.allow_soup = False

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

    def median_edge_length(self) -> float:
        """``h_ref`` of the paper's curvature metric: over the polygon edges as found."""
        ends: Ints = edges(self.joined)
        at = self.joined.vertices[ends]
        return float(np.median(np.linalg.norm(at[:, 0] - at[:, 1], axis=1)))

    def given_polygons(self) -> PolygonMesh:
        """With one vertex at every place; their union where closed parts cross."""
        return self.welded

    @property
    def options(self) -> frozenset[str]:
        return frozenset({"repair", "weld", "shells", "thickness"})

    def configure(self, values: Mapping[str, Any]) -> None:
        self.repair, self.reach = values["repair"], values["weld"]
        self.hollow = values["shells"] == "alternate"
        self.given_thickness, self.voxels = values["thickness"], values["n_init"]
        self.allow_soup = values["allow_poor_input"]

    def prepare(self, progress: Progress) -> None:
        """Find out whether it is a solid or a sheet. Raises InputError for a mesh that is not the
        surface of a solid."""
        thickness = self.given_thickness
        if thickness is None and not self.allow_soup:
            self.refuse_soup()
        if thickness is None and (self.flat or self.sureness < SHEET):
            thickness = float(np.ptp(self.bounding_box(), axis=0).max()) / self.voxels
        self.take_as_sheet(thickness or 0.0)

    def extra_memory(self) -> float:
        """Triangles are searched by compiled loops."""
        return 50.0

    def exact_creases(self, frame: ModelFrame, angle: float) -> list[Chain]:
        """The sharp edges of the mesh."""
        return of_triangles(frame.model_from_input(self.vertices), self.triangles, angle)

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
        return said + self.remarks() + self._open_warnings()

    def remarks(self) -> list[str]:
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
