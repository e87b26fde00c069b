"""Tetrahedra of polyhedral cells, for solvers without polyhedra.

The formats are MSH (Gmsh) and INP (Abaqus, CalculiX).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.geometry import fan_triangles
from ..mesh.polygons import Floats, Ints
from ..mesh.polyhedra import PolyhedralMesh
from .text import rows

VOLUME, SURFACE = "volume", "surface"


@dataclass(frozen=True)
class Split:
    """Cells that are divided into tetrahedra from their centroids to the triangles of their faces.

    Faces with more than three corners become fans about their centroids.
    """

    vertices: Floats
    tetrahedra: Ints
    """Corners ``(T, 4)``, with positive volume if the cell is sound."""
    cell: Ints
    """The cell of each tetrahedron, ``(T,)``."""
    boundary: Ints
    """The triangles ``(B, 3)`` of the boundary, counter-clockwise from outside."""
    turned: int
    """Number of tetrahedra with zero or negative volume."""


def split(mesh: PolyhedralMesh, points: Floats) -> Split:
    """The tetrahedra of ``mesh``. ``points (C, 3)`` lie near its cells."""
    vertices, triangles, cell = mesh.tetrahedra
    _, centroid = mesh.solids(points)
    volume = mesh.tetrahedron_volumes(centroid)
    apex = len(vertices) + cell
    # A triangle is counter-clockwise seen from outside, and clockwise seen from the centroid.
    corners = np.column_stack([triangles[:, [0, 2, 1]], apex])
    order = np.argsort(cell, kind="stable")
    _, every, face = fan_triangles(mesh.faces)
    return Split(
        np.concatenate([vertices, centroid]),
        corners[order],
        cell[order],
        every[mesh.neighbour[face] < 0],
        int((~(volume > 0)).sum()),
    )


def encode_msh(found: Split) -> bytes:
    """MSH 2.2 of Gmsh as text. Tetrahedra are in the physical group ``volume``, boundary
    triangles in ``surface``."""
    count, sides = len(found.tetrahedra), len(found.boundary)
    numbers = np.arange(1, count + sides + 1)

    def elements(first: int, kind: int, group: int, corners: Ints) -> Ints:
        row = np.tile([0, kind, 2, group, group], (len(corners), 1))
        row[:, 0] = numbers[first : first + len(corners)]
        return np.concatenate([row, corners + 1], axis=1)

    nodes = "\n".join(
        f"{number} {line}" for number, line in enumerate(rows(found.vertices).split("\n"), 1)
    )
    text = (
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
        f'$PhysicalNames\n2\n2 1 "{SURFACE}"\n3 2 "{VOLUME}"\n$EndPhysicalNames\n'
        f"$Nodes\n{len(found.vertices)}\n{nodes}\n$EndNodes\n"
        f"$Elements\n{count + sides}\n{rows(elements(0, 2, 1, found.boundary))}\n"
        f"{rows(elements(sides, 4, 2, found.tetrahedra))}\n$EndElements\n"
    )
    return text.encode("ascii")


def encode_inp(found: Split) -> bytes:
    """The mesh of an INP file: C3D4 elements in the set ``volume``, boundary
    nodes in ``surface``."""
    nodes = np.unique(found.boundary) + 1
    numbered = np.column_stack([np.arange(1, len(found.tetrahedra) + 1), found.tetrahedra + 1])
    places = "\n".join(
        f"{number}, {line}" for number, line in enumerate(rows(found.vertices, ", ").split("\n"), 1)
    )
    text = (
        f"*HEADING\nvorolight\n*NODE\n{places}\n"
        f"*ELEMENT, TYPE=C3D4, ELSET={VOLUME}\n{rows(numbered, ', ')}\n"
        f"*NSET, NSET={SURFACE}\n" + "\n".join(map(str, nodes.tolist())) + "\n"
    )
    return text.encode("ascii")
