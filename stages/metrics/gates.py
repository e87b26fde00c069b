"""The gates of a surface, and the elements that make it fail them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mesh.geometry import enclosed_volume, fan_triangles
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.queries.intersections import DEPTH, self_intersections
from ..mesh.topology import (
    CROWDED,
    OPEN,
    TURNED,
    edge_faults,
    edge_keys,
    pinched_vertices,
    topology,
)

NAMED = 20
"""Number of elements of each kind that are listed in a manifest. The PLY has all of them."""
CODES = {
    "open_edges": 1,
    "crowded_edges": 2,
    "turned_edges": 3,
    "pinched_vertices": 4,
    "crossing_faces": 5,
}
"""The number in the PLY of each kind of defect."""

FieldsOf = dict[str, Floats]


@dataclass(frozen=True)
class Defects:
    """Elements that a surface should not have."""

    open_edges: Ints
    """Edges ``(E, 2)`` in one face only."""
    crowded_edges: Ints
    """Edges ``(E, 2)`` in more than two faces, or from a vertex to itself."""
    turned_edges: Ints
    """Edges ``(E, 2)`` in two faces with opposite orientations."""
    pinched_vertices: Ints
    """Vertices ``(V,)`` whose faces form more than one fan."""
    crossing_faces: Ints
    """Pairs ``(P, 2)`` of faces that cross, and faces that cross themselves."""

    @property
    def count(self) -> int:
        return sum(len(getattr(self, kind)) for kind in CODES)

    def named(self) -> dict[str, Any]:
        """The number of elements of each kind, and the first of them."""
        return {
            kind: {"count": len(elements), "first": elements[:NAMED].tolist()}
            for kind in CODES
            if len(elements := getattr(self, kind))
        }

    def mesh(
        self, surface: PolygonMesh
    ) -> tuple[PolygonMesh, dict[str, Floats], dict[str, Floats]]:
        """The faces of ``surface`` at a defect, with data for vertices and for faces.

        The data are the number in ``surface``, and the code of the defect. If there are several,
        the lowest code is given; it is 0 for elements beside a defect.
        """
        vertex_code = np.full(surface.vertex_count, len(CODES) + 1)
        face_code = np.full(surface.face_count, len(CODES) + 1)
        keys, _ = edge_keys(surface)
        for kind, code in CODES.items():
            elements = getattr(self, kind)
            if kind == "crossing_faces":
                face_code[elements] = np.minimum(face_code[elements], code)
                continue
            vertex_code[elements] = np.minimum(vertex_code[elements], code)
            if kind == "pinched_vertices":
                corners = np.isin(surface.face_vertices, elements)
            else:
                corners = np.isin(keys, elements[:, 0] * surface.vertex_count + elements[:, 1])
            np.minimum.at(face_code, surface.corner_faces[corners], code)
        keep = face_code <= len(CODES)
        used = np.zeros(surface.vertex_count, dtype=bool)
        used[surface.face_vertices[keep[surface.corner_faces]]] = True
        part = surface.select_faces(keep).without_unused_vertices()
        near = np.where(vertex_code > len(CODES), 0, vertex_code)[used]
        return (
            part,
            {"defect": near.astype(float), "vertex": np.flatnonzero(used).astype(float)},
            {"defect": face_code[keep].astype(float), "face": np.flatnonzero(keep).astype(float)},
        )


def defects(mesh: PolygonMesh) -> Defects:
    """All defects of ``mesh``. Faces with more than three corners become fans
    about their centroids."""
    edges, fault = edge_faults(mesh)
    vertices, triangles, face = fan_triangles(mesh)
    return Defects(
        open_edges=edges[fault == OPEN],
        crowded_edges=edges[fault == CROWDED],
        turned_edges=edges[fault == TURNED],
        pinched_vertices=pinched_vertices(mesh),
        crossing_faces=np.unique(face[self_intersections(vertices, triangles)], axis=0),
    )


def gates(
    mesh: PolygonMesh, found: Defects, expected: tuple[int, int] | None
) -> dict[str, bool | str]:
    """Whether the surface passes each gate, or a sentence that says why that is not known.

    ``expected`` are the Euler number and the number of components of the reference.
    """
    facts = topology(mesh)
    directed = not len(found.turned_edges)
    closed = not len(found.open_edges) and facts.faces > 0
    manifold = not len(found.crowded_edges)
    return {
        "closed": closed,
        "edges_manifold": manifold,
        "vertices_manifold": not len(found.pinched_vertices),
        "oriented": directed,
        "outward": enclosed_volume(*fan_triangles(mesh)[:2]) > 0
        if closed and manifold and directed
        else "not known: the surface is not closed and oriented",
        "free_of_self_intersections": not len(found.crossing_faces),
        "topology": (facts.euler_number, facts.components) == expected
        if expected
        else "not known: the topology of the reference is not known",
    }


def failed(metrics: dict[str, Any]) -> dict[str, str]:
    """A sentence for each gate that fails."""
    count = {kind: entry["count"] for kind, entry in metrics["defects"].items()}
    first = {kind: entry["first"] for kind, entry in metrics["defects"].items()}

    def said(kind: str, text: str) -> str:
        names = ", ".join(
            "-".join(map(str, each)) if isinstance(each, list) else str(each)
            for each in first.get(kind, [])[:3]
        )
        more = ", ..." if count.get(kind, 0) > 3 else ""
        return f"{text}: {count.get(kind, 0)} ({names}{more})"

    facts = metrics["topology"]
    expected = metrics["expected_topology"] or {}
    words = {
        "closed": said("open_edges", "edges in one face only"),
        "edges_manifold": said("crowded_edges", "edges in more than two faces"),
        "vertices_manifold": said(
            "pinched_vertices", "vertices whose faces form more than one fan"
        ),
        "oriented": said("turned_edges", "edges whose two faces are turned against each other"),
        "outward": "the faces point inward",
        "free_of_self_intersections": said(
            "crossing_faces", f"pairs of faces that cross deeper than {DEPTH:g} of the diagonal"
        ),
        "topology": (
            f"Euler number {facts['euler_number']} and {facts['components']} components, where "
            f"the reference has {expected.get('euler_number')} and {expected.get('components')}"
        ),
        "certificate": "the certificate does not hold",
    }
    return {name: words[name] for name, held in metrics["gates"].items() if held is False}
