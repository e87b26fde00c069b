"""Quality of polyhedral meshes, as defined by checkMesh of OpenFOAM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mesh.geometry import face_sums
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.polyhedra import PolyhedralMesh
from ..mesh.topology import edges

BINS = 24
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Quality:
    """Measures of faces ``(F,)``, of faces between two cells ``(I,)``, of cells ``(C,)`` and of
    edges.

    Lengths are in the unit of the mesh, angles in degrees.
    """

    volume: Floats
    face_area: Floats
    edge_length: Floats
    non_orthogonality: Floats
    """Angle ``(I,)`` between a face's normal and the line between the centroids of its cells."""
    skewness: Floats
    """Distance ``(F,)`` from a face's centre to the point where the line between its cells'
    centroids meets its plane, divided by the extent of the face in that direction. At the boundary
    the line goes along the normal."""
    aspect: Floats
    """The aspect ratio ``(C,)``, which is the larger of two numbers. The first is the largest
    divided by the smallest of the sums of ``|S_f|`` for each axis. The second is their total
    divided by that of a cube with the same volume."""
    size_ratio: Floats
    """Size (cube root of the volume) of the larger cell of a face, divided by that of
    the smaller, ``(I,)``."""
    cell_non_orthogonality: Floats
    cell_skewness: Floats


def face_centres(mesh: PolygonMesh) -> tuple[Floats, Floats]:
    """Vector areas ``(F, 3)``, and centres weighted by the areas of a fan about
    the mean of the corners."""
    corners = mesh.vertices[mesh.face_vertices]
    apex = face_sums(mesh, corners) / mesh.valences[:, None]
    following = mesh.vertices[mesh.next_vertices]
    at = apex[mesh.corner_faces]
    fan = 0.5 * np.cross(corners - at, following - at)
    weight = np.linalg.norm(fan, axis=1)
    total = face_sums(mesh, weight)
    offset = face_sums(mesh, weight[:, None] * (corners + following - 2 * at)) / 3
    return face_sums(mesh, fan), apex + offset / np.maximum(total, TINY)[:, None]


def quality(mesh: PolyhedralMesh) -> Quality:
    """The quality of ``mesh``, which is not changed."""
    faces, owner, count = mesh.faces, mesh.owner, mesh.cell_count
    inner = np.flatnonzero(mesh.neighbour >= 0)
    other = mesh.neighbour[inner]
    area, centre = face_centres(faces)

    def summed(of_owner: Floats, of_neighbour: Floats) -> Floats:
        total = np.bincount(owner, of_owner, minlength=count)
        return np.asarray(total + np.bincount(other, of_neighbour[inner], minlength=count))

    ones = np.ones(faces.face_count)
    per_cell = summed(ones, ones)
    middle = np.stack([summed(c, c) for c in centre.T], axis=1) / per_cell[:, None]
    pyramids = [
        np.einsum("ij,ij->i", sign * area, centre - middle[cell]) / 3
        for sign, cell in ((1.0, owner), (-1.0, mesh.neighbour))
    ]
    volume = summed(*pyramids)
    centroid = (
        np.stack(
            [
                summed(
                    *(
                        height * (0.75 * centre[:, k] + 0.25 * middle[cell, k])
                        for height, cell in zip(pyramids, (owner, mesh.neighbour), strict=True)
                    )
                )
                for k in range(3)
            ],
            axis=1,
        )
        / np.maximum(np.abs(volume), TINY)[:, None]
        * np.where(volume < 0, -1.0, 1.0)[:, None]
    )

    magnitude = np.linalg.norm(area, axis=1)
    way = centroid[other] - centroid[owner[inner]]
    along = np.einsum("ij,ij->i", way, area[inner])
    reach = np.linalg.norm(way, axis=1)
    cosine = along / np.maximum(reach * magnitude[inner], TINY)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    # From the owner's centroid ``there`` leads to the face's centre, and ``line`` to the other
    # centroid or, at the boundary, to the face along its normal.
    there = centre - centroid[owner]
    unit = area / np.maximum(magnitude, TINY)[:, None]
    line = unit * np.einsum("ij,ij->i", unit, there)[:, None]
    line[inner] = way
    least = 0.4 * np.linalg.norm(line, axis=1)
    least[inner] *= 0.5
    share = np.einsum("ij,ij->i", area, there) / _away(np.einsum("ij,ij->i", area, line))
    miss = there - share[:, None] * line
    length = np.linalg.norm(miss, axis=1)
    towards = miss / np.maximum(length, TINY)[:, None]
    face = faces.corner_faces
    extent = np.abs(
        np.einsum("ij,ij->i", towards[face], faces.vertices[faces.face_vertices] - centre[face])
    )
    widest = np.maximum.reduceat(extent, faces.face_offsets[:-1])
    skewness = length / np.maximum(np.maximum(least, widest), TINY)

    sides = np.stack([summed(*([np.abs(a)] * 2)) for a in area.T], axis=1)
    aspect = np.maximum(
        sides.max(axis=1) / np.maximum(sides.min(axis=1), TINY),
        sides.sum(axis=1) / (6 * np.maximum(volume, TINY) ** (2 / 3)),
    )
    size = np.cbrt(np.maximum(volume, TINY))
    ratio = size[owner[inner]] / size[other]
    ends = edges(faces)
    return Quality(
        volume=volume,
        face_area=magnitude,
        edge_length=np.linalg.norm(faces.vertices[ends[:, 0]] - faces.vertices[ends[:, 1]], axis=1),
        non_orthogonality=angle,
        skewness=skewness,
        aspect=aspect,
        size_ratio=np.maximum(ratio, 1 / ratio),
        cell_non_orthogonality=_worst(count, (owner[inner], angle), (other, angle)),
        cell_skewness=_worst(count, (owner, skewness), (other, skewness[inner])),
    )


def _away(values: Floats) -> Floats:
    """``values``, with zeros replaced by a tiny number."""
    return np.where(np.abs(values) < TINY, TINY, values)


def _worst(count: int, *parts: tuple[Ints, Floats]) -> Floats:
    worst = np.zeros(count)
    for cell, values in parts:
        np.maximum.at(worst, cell, values)
    return worst


def distribution(values: Floats, logarithmic: bool) -> dict[str, Any]:
    """Least, mean, median, 95th and 99th percentile and largest of ``values``, and a histogram."""
    low, high = float(values.min()), float(values.max())
    if logarithmic and low > 0:
        edges_of = np.geomspace(low, max(high, low * (1 + 1e-9)), BINS + 1)
    else:
        edges_of = np.linspace(low, max(high, low + 1e-12), BINS + 1)
    # Rounding must not make the last edge smaller than the largest value.
    edges_of[0], edges_of[-1] = low, max(high, edges_of[-1])
    counts, _ = np.histogram(values, edges_of)
    median, p95, p99 = np.quantile(values, [0.5, 0.95, 0.99])
    return {
        "least": low,
        "mean": float(values.mean()),
        "median": float(median),
        "p95": float(p95),
        "p99": float(p99),
        "most": high,
        "histogram": {"edges": edges_of.tolist(), "counts": counts.tolist()},
    }


def summary(found: Quality) -> dict[str, Any]:
    """The figures of ``found`` for the manifest."""
    return {
        name: distribution(getattr(found, name), name in ("volume", "face_area", "edge_length"))
        for name in (
            "volume", "face_area", "edge_length", "non_orthogonality", "skewness", "aspect",
            "size_ratio",
        )
    }  # fmt: skip


def cell_data(mesh: PolyhedralMesh, role: Ints, volume: Floats, found: Quality) -> dict[str, Any]:
    """Data of each cell ``(C,)`` for files. ``role (C,)`` is 1 at the surface, and 2 inside."""
    return {
        "generator": mesh.cell_generator,
        "role": role,
        "volume": volume,
        "faces": np.bincount(mesh.half_faces[1], minlength=mesh.cell_count),
        "non_orthogonality": found.cell_non_orthogonality,
        "skewness": found.cell_skewness,
        "aspect": found.aspect,
    }
