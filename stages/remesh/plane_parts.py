"""The parts of a triangle surface under which the shape is plane."""

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
"""Two triangles are in one plane if the sine of the angle between their normals, and the height
divided by the edge length, are less."""
BESIDE = 0.02
"""A triangle is not in a plane part if a corner is further from the plane, in edge lengths."""
LEAST = 30
"""Smallest number of triangles of a plane part. The facets of a round shape
in an input have fewer."""
MOST = 3
"""Largest number of plane parts at a vertex. More than three planes only meet up to rounding."""


@dataclass(frozen=True)
class PlaneParts:
    """The plane part ``(T,)`` of each triangle, or -1, and the planes ``normal . x = offset``."""

    part: Ints
    normal: Floats
    offset: Floats

    def of_groups(self, group: Ints) -> Ints:
        """The part that contains all triangles of each ``group (T,)``, or -1."""
        least, most = np.full(len(group), len(group)), np.full(len(group), -1)
        np.minimum.at(least, group, self.part)
        np.maximum.at(most, group, self.part)
        return np.where(least == most, most, -1)


def plane_parts(mesh: Sized, table: EdgeTable, surface: NearSurface, lengths: Floats) -> PlaneParts:
    """The plane parts, from the closest points of the triangles' centroids and the normals there.

    ``lengths (T,)`` are the edge lengths of the triangles. Creases bound the parts.
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
    # Many small angles in a row add up: triangles are compared with the mean plane.
    off = np.maximum(
        np.abs(along - offset[part]) / lengths,
        np.linalg.norm(np.cross(normal, mean[part]), axis=1),
    )
    bent = np.zeros(number, dtype=bool)
    bent[part[off > FLAT]] = True
    # A triangle that extends over the boundary of a plane part does not belong to it.
    aside = np.abs(np.einsum("tkj,tj->tk", corners, mean[part]) - offset[part, None])
    part = np.where(bent[part] | (aside.max(axis=1) > BESIDE * lengths), -1, part)
    size = np.bincount(part[part >= 0], minlength=number)
    part = np.where(size[part] < LEAST, -1, part)
    vertex, there = np.unique(np.stack([mesh.triangles.reshape(-1), np.repeat(part, 3)]), axis=1)
    crowded = np.bincount(vertex[there >= 0], minlength=len(mesh.vertices)) > MOST
    part[crowded[mesh.triangles].any(axis=1)] = -1
    return PlaneParts(part, mean, offset)
