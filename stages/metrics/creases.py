"""Agreement between the sharp edges of a surface and the creases of its reference.

It is similar to the edge F1 of Chen and Zhang, *Neural Marching Cubes* (2021), which compares
samples of surfaces near which normals differ. Here the samples lie on the edges, and distances are
to edges, so that the density of samples does not limit them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..inputs.creases.sharp_edges import ANGLE
from ..mesh.geometry import face_frames
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.topology import edge_keys

if TYPE_CHECKING:
    from ..inputs.source import Source
    from ..mesh.model_frame import ModelFrame

SHARP = 30.0
"""Smallest angle in degrees of a sharp edge of the surface.

It is less than ANGLE, because triangles that are not exactly on both sides make a crease a little
flatter. Where a crease fades out, its edges of 30 to 40 degrees therefore lower the precision, even
for the reference itself.
"""
TOLERANCE = 0.005
"""Largest distance at which edges agree, divided by the longest side of the reference's box."""
STEP = 0.2
"""Distance between samples on edges, in tolerances."""
MOST_POINTS = 1_000_000
"""Largest number of samples. On a rough surface nearly every edge is sharp."""


@dataclass(frozen=True)
class CreaseAgreement:
    """Agreement of the sharp edges of a surface and the creases of its reference.

    Shares are shares of length. Distances are in units of h0, the voxel edge of the run in which
    the surface is evaluated. They are None if the surface has no sharp edge.
    """

    edge_f1: float
    """The harmonic mean of recall and precision; 0 if there are no sharp edges."""
    edge_recall: float
    """Share of the creases that are within the tolerance of a sharp edge."""
    edge_precision: float
    """Share of the sharp edges that are within the tolerance of a crease."""
    distance_median: float | None
    """Median distance from samples of the creases to the closest sharp edge."""
    distance_p99: float | None
    crease_length: float
    """Length of all creases, divided by the longest side of the reference's box."""
    sharp_length: float
    """Length of all sharp edges, divided by the same length."""
    tolerance: float
    """The tolerance, divided by the same length."""
    crease_angle: float
    """Smallest angle in degrees of a crease of the reference."""
    sharp_angle: float
    """Smallest angle in degrees of a sharp edge of the surface."""


@dataclass(frozen=True)
class Segments:
    """Straight segments between ``vertices (V, 3)``, with their indices ``ends (S, 2)``."""

    vertices: Floats
    ends: Ints

    @cached_property
    def lengths(self) -> Floats:
        """The length of each segment, ``(S,)``."""
        start, end = self.vertices[self.ends[:, 0]], self.vertices[self.ends[:, 1]]
        return np.asarray(np.linalg.norm(end - start, axis=1))

    @property
    def length(self) -> float:
        return float(self.lengths.sum())

    @cached_property
    def tree(self) -> Any:
        import igl

        tree = igl.AABB()
        tree.init(self.vertices, self.ends)
        return tree

    def points(self, step: float) -> Floats:
        """Points ``(N, 3)`` along all segments, evenly spaced by ``step`` or slightly less.

        There are at most MOST_POINTS.
        """
        total = self.length
        count = int(np.clip(np.ceil(total / step), 1, MOST_POINTS))
        along = (np.arange(count) + 0.5) * (total / count)
        until = np.cumsum(self.lengths)
        piece = np.minimum(np.searchsorted(until, along, side="right"), len(until) - 1)
        length = np.maximum(self.lengths[piece], np.finfo(float).tiny)
        share = np.clip(1 - (until[piece] - along) / length, 0, 1)[:, None]
        start, end = self.vertices[self.ends[piece, 0]], self.vertices[self.ends[piece, 1]]
        return np.asarray((1 - share) * start + share * end)

    def distance(self, points: Floats) -> Floats:
        """The distance ``(N,)`` of ``points (N, 3)`` from the closest segment."""
        square, _, _ = self.tree.squared_distance(
            self.vertices, self.ends, np.ascontiguousarray(points)
        )
        return np.sqrt(np.asarray(square, dtype=np.float64))


def of_reference(source: Source, frame: ModelFrame) -> Segments | None:
    """The creases of a mesh or field, in its own unit. None if it has none, or is neither."""
    chains = source.exact_creases(frame, ANGLE)
    if not chains:
        return None
    counts = np.array([len(chain.points) for chain in chains])
    first = np.ones(counts.sum(), dtype=bool)
    first[np.cumsum(counts) - 1] = False
    start = np.flatnonzero(first)
    points = np.concatenate([chain.points for chain in chains])
    return Segments(
        np.ascontiguousarray(frame.input_from_model(points)), np.stack([start, start + 1], axis=1)
    )


def sharp_edges(mesh: PolygonMesh, angle: float = SHARP) -> Segments | None:
    """The edges between two faces whose normals differ by ``angle`` degrees or more; None if none
    do.

    Edges in one face, or in more than two, do not count.
    """
    _, normal, _ = face_frames(mesh)
    keys, forward = edge_keys(mesh)
    order = np.argsort(keys, kind="stable")
    _, first, uses = np.unique(keys[order], return_index=True, return_counts=True)
    first = first[uses == 2]
    one, other = order[first], order[first + 1]
    n1, n2 = normal[mesh.corner_faces[one]], normal[mesh.corner_faces[other]]
    sine = np.linalg.norm(np.cross(n1, n2), axis=1)
    turn = np.arctan2(sine, np.einsum("ij,ij->i", n1, n2))
    sharp = one[(turn >= np.radians(angle)) & (forward[one] != forward[other])]
    ends = np.stack([mesh.face_vertices[sharp], mesh.next_vertices[sharp]], axis=1)
    edges = Segments(np.ascontiguousarray(mesh.vertices), ends)
    return edges if edges.length > 0 else None


def agreement(
    creases: Segments, mesh: PolygonMesh, longest: float, spacing: float
) -> CreaseAgreement:
    """The agreement of the sharp edges of ``mesh`` and the ``creases`` of its reference.

    All are in one frame, in which ``longest`` is the longest side of the reference's box, and
    ``spacing`` is h0.
    """
    tolerance = TOLERANCE * longest
    edges = sharp_edges(mesh)
    recall = precision = 0.0
    median = p99 = None
    if edges is not None:
        away = edges.distance(creases.points(STEP * tolerance))
        recall = float((away <= tolerance).mean())
        astray = creases.distance(edges.points(STEP * tolerance))
        precision = float((astray <= tolerance).mean())
        median = float(np.median(away)) / spacing
        p99 = float(np.percentile(away, 99)) / spacing
    both = recall + precision
    return CreaseAgreement(
        edge_f1=2 * recall * precision / both if both > 0 else 0.0,
        edge_recall=recall,
        edge_precision=precision,
        distance_median=median,
        distance_p99=p99,
        crease_length=creases.length / longest,
        sharp_length=0.0 if edges is None else edges.length / longest,
        tolerance=TOLERANCE,
        crease_angle=ANGLE,
        sharp_angle=SHARP,
    )
