"""The first generators for shapes whose true surface is known: pairs mirrored across it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mesh.polygons import Floats
from ...mesh.queries.true_surface import TrueSurface
from ...remesh.length_field import THINNEST, LengthField, thickness

BAND = 3
"""Number of layers of cells on each side of the boundary of the interior voxels."""
MIRRORED = 1.2
"""Largest distance to the surface, in cell edges, of a generator that is mirrored."""
NEAREST = 0.02
"""Smallest distance to the surface, in cell edges, of a generator that is mirrored."""
HALVINGS = 6
"""Number of times that a pair is moved closer to the surface to fit into a thin part."""
FINER = 0.75
"""A cell is divided if the target edge is less than this share of its edge."""
ALONE = 0.7
"""A mirror image must have no other part of the surface within this share of its distance."""
JITTER = 1e-3
"""Standard deviation of random shifts. Cell centres are shifted by this share of a cell edge,
mirror images by this share of their distance to the surface."""
FAR = 60
"""Number of outside generators far away, which bound the diagram."""


def mirrored(
    surface: TrueSurface, interior: NDArray[np.bool_], levels: int, random: np.random.Generator
) -> tuple[Floats, NDArray[np.bool_]]:
    """The first generators ``(N, 3)`` in model units, and whether each is inside, ``(N,)``.

    The centres of the voxels around the boundary of ``interior`` are mirrored across the true
    surface, so that the interface passes close to the surface from the start. In model units, the
    edge of a voxel is 1. Where the shape or a gap is thinner than a voxel, cells are divided up to
    ``levels`` times. Centres further away are not mirrored.
    """
    from scipy.ndimage import binary_dilation

    near = binary_dilation(interior, iterations=BAND)
    near &= binary_dilation(~interior, iterations=BAND)
    places: Floats = np.argwhere(near).astype(np.float64) + 0.5
    edge = np.ones(len(places))
    if levels:
        smallest = 0.5**levels
        thin = thickness(surface.samples, surface.normals, 1.0 / THINNEST)
        wanted = LengthField(surface.samples, np.clip(THINNEST * thin, smallest, 1.0))
        for _ in range(levels):
            places, edge = _divided(places, edge, surface, wanted)
    places = places + JITTER * edge[:, None] * random.standard_normal(places.shape)
    foot, _ = surface.closest(places)
    away = places - foot
    distance = np.linalg.norm(away, axis=1)
    deep = distance >= MIRRORED * edge
    pair = ~deep & (distance > NEAREST * edge)
    foot, direction = foot[pair], away[pair] / distance[pair, None]
    within = surface.inside(places[pair])
    offset, fits = _fitted(surface, foot, direction, distance[pair], within)
    shift = offset[fits, None] * direction[fits]
    here, there, label = foot[fits] + shift, foot[fits] - shift, within[fits]
    # Two pairs that are mirrored across one plane lie on a circle, three on a sphere. A tetrahedron
    # of two pairs would be flat, and rounding would decide its circumcentre.
    there += JITTER * offset[fits, None] * random.standard_normal(there.shape)
    fill = places[deep]
    far = _far_away(places)
    generators = np.concatenate([here, there, fill, far])
    inside = np.concatenate([label, ~label, surface.inside(fill), np.zeros(len(far), bool)])
    return generators, inside


def _divided(
    places: Floats, edge: Floats, surface: TrueSurface, wanted: LengthField
) -> tuple[Floats, Floats]:
    """The cells, of which those near a thin part are replaced by their eight octants."""
    foot, _ = surface.closest(places)
    split = wanted(foot) < FINER * edge
    split &= np.linalg.norm(places - foot, axis=1) < (MIRRORED + 0.9) * edge
    corner = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    parts = places[split][:, None] + 0.25 * edge[split][:, None, None] * corner
    return (
        np.concatenate([places[~split], parts.reshape(-1, 3)]),
        np.concatenate([edge[~split], np.repeat(0.5 * edge[split], 8)]),
    )


def _fitted(
    surface: TrueSurface,
    foot: Floats,
    direction: Floats,
    distance: Floats,
    within: NDArray[np.bool_],
) -> tuple[Floats, NDArray[np.bool_]]:
    """Offsets ``(N,)`` at which both points of a pair are on their own sides,
    and where there is one."""
    offset, fits = distance.copy(), np.zeros(len(foot), dtype=bool)
    left = np.arange(len(foot))
    for _ in range(HALVINGS):
        shift = offset[left, None] * direction[left]
        image = foot[left] - shift
        clear = np.linalg.norm(image - surface.closest(image)[0], axis=1) > ALONE * offset[left]
        good = clear & (surface.inside(image) != within[left])
        good &= surface.inside(foot[left] + shift) == within[left]
        fits[left[good]] = True
        left = left[~good]
        offset[left] *= 0.5
        if len(left) == 0:
            break
    return offset, fits


def _far_away(places: Floats) -> Floats:
    """Points in all directions on a sphere with the diagonal as radius, along a spiral."""
    low, high = places.min(axis=0), places.max(axis=0)
    height = np.linspace(-0.98, 0.98, FAR)
    angle = np.arange(FAR) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    return np.asarray(0.5 * (low + high) + np.linalg.norm(high - low) * sphere)
