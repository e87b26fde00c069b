"""The first generators where the true surface is known: pairs mirrored in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mesh.polygons import Floats
from ...mesh.queries.true_surface import TrueSurface
from ...remesh.length_field import THINNEST, LengthField, thickness

BAND = 3
"""Layers of cells on either side of the boundary of the interior voxels."""
MIRRORED = 1.2
"""Distance to the surface, in cell edges, up to which a generator gets a mirror image."""
NEAREST = 0.02
"""Distance, in cell edges, below which a place is too close to the surface to be mirrored."""
HALVINGS = 6
"""How often a pair is moved closer to the surface to fit into a thin part."""
FINER = 0.75
"""A cell is divided if its wanted edge is less than this share of its edge."""
ALONE = 0.7
"""A mirror image must have no other piece of surface within this share of its distance."""
JITTER = 1e-3
"""Standard deviation of the shifts of cell centres off their lattice, in cell edges, and of mirror
images off their plane, as a share of their distance to it."""
FAR = 60
"""Number of generators far outside, which bound the diagram."""


def mirrored(
    surface: TrueSurface, interior: NDArray[np.bool_], levels: int, random: np.random.Generator
) -> tuple[Floats, NDArray[np.bool_]]:
    """Generators ``(N, 3)`` in model units and which are inside.

    The centres of the voxels around the boundary of ``interior`` (model units: the voxel edge is 1)
    come with their mirror image in the true surface, so that the surface passes where it should
    from the start. Where the shape or a gap is thinner than a voxel, cells are divided up to
    ``levels`` times. Centres further away carry their label only.
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
    # Any two pairs mirrored in one plane lie on a circle, and three on a sphere: a tetrahedron of
    # two pairs would be flat, its circumcentre a matter of rounding.
    there += JITTER * offset[fits, None] * random.standard_normal(there.shape)
    fill = places[deep]
    far = _far_away(places)
    generators = np.concatenate([here, there, fill, far])
    inside = np.concatenate([label, ~label, surface.inside(fill), np.zeros(len(far), bool)])
    return generators, inside


def _divided(
    places: Floats, edge: Floats, surface: TrueSurface, wanted: LengthField
) -> tuple[Floats, Floats]:
    """The cells, where those near a thin part are replaced by their eight parts."""
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
    """Offsets ``(N,)`` at which both points of a pair are on the right side, and whether there is
    one."""
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
    """Points in all directions at the distance of the diagonal, on a spiral over a sphere."""
    low, high = places.min(axis=0), places.max(axis=0)
    height = np.linspace(-0.98, 0.98, FAR)
    angle = np.arange(FAR) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    return np.asarray(0.5 * (low + high) + np.linalg.norm(high - low) * sphere)
