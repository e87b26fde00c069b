"""Where the shape under a triangle surface is plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..mesh.edge_table import EdgeTable, Sized
from ..mesh.geometry import triangle_normals
from ..mesh.graph import components
from ..mesh.polygons import Floats, Ints

if TYPE_CHECKING:
    from ..mesh.queries.true_surface import NearSurface

FLAT = 1e-3
"""Sine of the angle between normals, and height over the edge length, up to which two triangles are
of one plane."""
BESIDE = 0.02
"""Height of a corner beyond its plane, in edge lengths, above which its triangle is not of it."""
LEAST = 30
"""Fewest triangles of a plane part: the facets that stand for something round have fewer."""
MOST = 3
"""Plane parts that may meet at a vertex: more than three planes do so only up to rounding."""


@dataclass(frozen=True)
class PlaneParts:
    """The plane part ``(T,)`` that each triangle lies in, or -1, and the planes ``normal . x =
    offset`` of the parts."""

    part: Ints
    normal: Floats
    offset: Floats

    def of_groups(self, group: Ints) -> Ints:
        """The part that all triangles of each ``group (T,)`` lie in, or -1, by the group."""
        least, most = np.full(len(group), len(group)), np.full(len(group), -1)
        np.minimum.at(least, group, self.part)
        np.maximum.at(most, group, self.part)
        return np.where(least == most, most, -1)


def plane_parts(mesh: Sized, table: EdgeTable, surface: NearSurface, lengths: Floats) -> PlaneParts:
    """The plane parts, by the closest points of the triangles' middles and the normals there.

    ``lengths (T,)``: the edge length at each triangle. Creases bound the parts.
    """
    count, corners = len(mesh.triangles), mesh.vertices[mesh.triangles]
    facing, _ = triangle_normals(mesh.vertices, mesh.triangles)
    foot, normal = surface.closest(corners.mean(axis=1), facing)
    first, second = table.triangles.T
    turned = np.linalg.norm(np.cross(normal[first], normal[second]), axis=1)
    height = np.abs(np.einsum("ij,ij->i", foot[second] - foot[first], normal[first]))
    same = (turned < FLAT) & (height < FLAT * table.lengths(mesh.vertices))
    same &= np.einsum("ij,ij->i", normal[first], normal[second]) > 0
    same &= ~mesh.on_crease(table.ends)
    number, part = components(count, table.triangles[same])
    sums = [np.bincount(part, column, minlength=number) for column in normal.T]
    mean = np.stack(sums, axis=1).astype(np.float64)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), np.finfo(float).tiny)
    along = np.einsum("ij,ij->i", foot, mean[part])
    offset = np.bincount(part, along, minlength=number) / np.bincount(part, minlength=number)
    # Many small turns in a row are no plane.
    off = np.maximum(
        np.abs(along - offset[part]) / lengths,
        np.linalg.norm(np.cross(normal, mean[part]), axis=1),
    )
    bent = np.zeros(number, dtype=bool)
    bent[part[off > FLAT]] = True
    # A triangle that reaches over the edge of a plane part is not of it.
    aside = np.abs(np.einsum("tkj,tj->tk", corners, mean[part]) - offset[part, None])
    part = np.where(bent[part] | (aside.max(axis=1) > BESIDE * lengths), -1, part)
    size = np.bincount(part[part >= 0], minlength=number)
    part = np.where(size[part] < LEAST, -1, part)
    vertex, there = np.unique(np.stack([mesh.triangles.reshape(-1), np.repeat(part, 3)]), axis=1)
    crowded = np.bincount(vertex[there >= 0], minlength=len(mesh.vertices)) > MOST
    part[crowded[mesh.triangles].any(axis=1)] = -1
    return PlaneParts(part, mean, offset)
