"""The lattice of an object: tubes along edges, and the faces that plates or tubes close."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import UsageError
from ..mesh.polygons import Floats, Ints, PolygonMesh
from . import assembly, plates, solid, tubes
from .lamp import Stance

if TYPE_CHECKING:
    from ..progress import Progress

CELL_TO_TUBE, LEAST_NOZZLES, MOST_NOZZLES = 0.6, 2.5, 8.0
"""The default diameter of tubes, divided by the radius of the faces, and its
limits in nozzle widths."""
MOST_SEALED = 0.5
"""Tubes are refused if they close a larger share of the faces."""


@dataclass(frozen=True)
class Shape:
    """The surface and cells of an object, in the coordinates of the input."""

    polygons: PolygonMesh
    """The polygons whose edges the tubes follow."""
    surface: PolygonMesh
    """A closed surface that bounds the inside of the object."""
    drawn: str
    volume: Mapping[str, Any] | None
    """The arrays of the volume stage, if cells are asked for."""


@dataclass(frozen=True)
class Design:
    """The dimensions of tubes and plates, in mm."""

    edges: str
    diameter: float | None
    taper: float
    sides: int
    fillet: bool
    merge: float | None
    plates: float
    plate_pattern: str
    plate_thickness: float
    cable: float | None
    nozzle: float
    layer: float
    check: Callable[[float], None]
    """A function that raises UsageError if a diameter does not fit the other dimensions."""


@dataclass(frozen=True)
class Lattice:
    """United tubes and plates, in mm."""

    body: Any
    graph: tubes.TubeGraph
    radii: Floats
    """The radii of the tubes at the nodes, ``(K,)``."""
    gaps: Floats
    """The radius of the opening that tubes leave in each face, ``(F,)``."""
    sealed: Ints
    """The faces whose opening is narrower than the nozzle. Panes close them."""
    chosen: Ints
    """The faces that became plates."""
    thickness: float
    """Thickness of the panes, in mm."""
    touching: int
    """Number of places where tubes touch: the genus of the body, minus that of the graph
    without the closed faces."""
    genus: int

    @property
    def panes(self) -> Ints:
        return np.union1d(self.chosen, self.sealed)

    @property
    def open_area(self) -> Floats:
        """The open share of each face, ``(F,)``."""
        wide = np.maximum(self.gaps, 0)
        share = (wide / np.maximum(wide + self.radii.mean(), 1e-300)) ** 2
        share[self.panes] = 0
        return np.asarray(share)


def build(
    shape: Shape, stance: Stance, design: Design, diameter: float, random: np.random.Generator,
    progress: Progress,
) -> Lattice:  # fmt: skip
    """The lattice of ``shape`` at the placement ``stance``."""
    graph = _graph(shape, stance, design, diameter)
    if len(graph.tubes) == 0:
        raise UsageError(f"--merge {design.merge or 0:g}: contracts every edge; lower it")
    radii = tubes.tapered(graph.nodes, diameter / 2, design.taper)
    gaps = plates.openings(graph.faces, radii * enlargement(design))
    closed = gaps < design.nozzle / 2
    sealed, free = np.flatnonzero(closed), np.flatnonzero(~closed)
    bodies = tubes.tubes(graph, radii, design.sides, design.fillet)
    progress.advance(1, f"{len(graph.tubes)} tubes")
    open_faces = graph.faces.select_faces(~closed)
    chosen = free[plates.choose(open_faces, design.plates, design.plate_pattern, random)]
    thickness = min(design.plate_thickness, float(2 * radii.min()))
    panes = np.union1d(chosen, sealed)
    bodies += plates.plates(graph.faces, panes, thickness)
    body = assembly.union(bodies)
    genus = assembly.handles(body)
    touching = genus - (graph.loops - len(panes))
    return Lattice(body, graph, radii, gaps, sealed, chosen, thickness, touching, genus)


def enlargement(design: Design) -> float:
    """Factor by which the radius of a tube with this number of sides is enlarged."""
    return tubes.compensation(tubes.ball(design.sides))


def followed(shape: Shape, design: Design) -> tuple[PolygonMesh, Ints]:
    """The mesh along whose edges tubes go, and the face of the surface or volume
    of each of its faces."""
    if design.edges == "surface":
        return shape.polygons, np.arange(shape.polygons.face_count)
    assert shape.volume is not None
    mesh = PolygonMesh.from_arrays(shape.volume)
    if design.edges == "both":
        return mesh, np.arange(mesh.face_count)
    key = mesh.vertex_count
    sides = np.sort(np.stack([mesh.face_vertices, mesh.next_vertices], axis=1), axis=1)
    there = np.isin(sides @ [key, 1], solid.edges_of(shape.volume, "volume") @ [key, 1])
    kept = np.bincount(mesh.corner_faces, ~there, minlength=mesh.face_count) == 0
    return mesh.select_faces(kept), np.flatnonzero(kept)


def _graph(shape: Shape, stance: Stance, design: Design, diameter: float) -> tubes.TubeGraph:
    weld = diameter / 2 if design.merge is None else design.merge
    mesh, sources = followed(shape, design)
    wanted = None
    if design.edges != "surface":
        assert shape.volume is not None
        wanted = solid.edges_of(shape.volume, design.edges)
    graph = tubes.tube_graph(stance.apply(mesh), weld, wanted)
    if design.edges == "surface" and len(graph.tubes):
        graph = tubes.raised(graph, stance.lift + diameter, float(graph.lengths.mean()))
    return replace(graph, face_sources=sources[graph.face_sources])


def default_diameter(mesh: PolygonMesh, design: Design) -> float:
    """The tube diameter in mm that suits the faces of ``mesh``, but at least what
    plates or a taper need."""
    radius = float(np.median(plates.openings(mesh, np.zeros(mesh.vertex_count))))
    end = max(2 * design.nozzle, design.plate_thickness if design.plates > 0 else 0.0)
    least = max(LEAST_NOZZLES * design.nozzle, end / design.taper)
    wanted = max(least, min(CELL_TO_TUBE * radius, MOST_NOZZLES * design.nozzle))
    return float(np.ceil(100 * wanted) / 100)


def refuse_thick(mesh: PolygonMesh, outer: float, diameter: float, design: Design) -> None:
    """Raise UsageError if tubes with the radius ``outer`` close more than
    MOST_SEALED of the faces."""
    gaps = plates.openings(mesh, np.full(mesh.vertex_count, outer))
    closed = np.flatnonzero(gaps < design.nozzle / 2)
    if len(closed) <= MOST_SEALED * mesh.face_count:
        return
    named = ", ".join(map(str, closed[np.argsort(gaps[closed])[:5]].tolist()))
    most = diameter + 2 * float(np.median(gaps)) - design.nozzle
    way = f"at most {most:.1f} keeps half of them open: lower it, "
    raise UsageError(
        f"--tube-diameter {diameter:g}: would close {len(closed)} of {mesh.face_count} faces "
        f"(first {named}); {way if most >= 2 * design.nozzle else ''}raise --height or make larger "
        "cells with -n or --edge-length"
    )
