"""The certificate: a trained surface is the interface of its generators' Voronoi diagram.

In exact arithmetic this holds if five conditions do:

1. ``incident``: every generator lies on the spheres at the corners of its face;
2. ``exclusion``: no generator lies inside any other sphere;
3. ``rings``: each face is a flat, convex polygon of nonzero area, every edge is in two faces with
   opposite directions, and every vertex in three faces or more;
4. ``orientation``: each face's normal points from its inside to its outside generator;
5. ``winding``: the surface winds once around every inside generator, and around no outside one.

The power of a point c and a sphere (c_v, r_v) is ``|c - c_v|^2 - r_v^2``. By 1 and 2, each corner
of a face is at least as near to the face's pair as to any other generator. Differences of squared
distances are affine, so the same holds on the whole face: it lies in the Voronoi face of its pair.
Hence no cell crosses the surface, and by 4 and 5 there is no other interface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.geometry import face_frames, fan_triangles
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.queries.parity import RayParity
from ..mesh.spheres import held, without
from ..mesh.topology import bad_edges

TAU = 1e-8
"""Largest ``|power|`` of a generator to the spheres at its face's corners, in units of h0^2."""
MARGIN = 1e-5
"""Smallest power that any other generator may have, in units of h0^2."""
PLANAR = 1e-8
"""Largest distance of a corner from the plane of its face, in units of h0."""
REACH = 0.5
"""Distance beyond a sphere, in units of h0, up to which powers of generators are measured."""
NEAR = 0.2
"""The distance beyond a sphere of the first search, in median radii."""


@dataclass(frozen=True)
class Certificate:
    """The result of the checks. Lengths are in units of h0."""

    holds: bool
    failed: tuple[str, ...]
    """The names of the conditions that fail: incident, exclusion, rings, orientation, winding."""
    incident_power: float
    """tau: the largest ``|power|`` of a generator to the spheres at its face's corners."""
    margin: float
    """m: the smallest power of a generator to a sphere that is not at its face's corners. Larger
    values than REACH^2 are not measured."""
    intruders: int
    """Number of pairs of a generator and a sphere, not of its face, with a power below MARGIN."""
    bad_rings: int
    """Number of faces that are not flat and convex with an area, and of edges that
    are not in two faces."""
    turned_faces: int
    """Number of faces whose normal does not point from the inside to the outside generator."""
    wound_wrongly: int
    """Number of generators on the wrong side of the surface."""
    smallest_offset: float
    """Half the smallest distance between the two generators of a face."""
    conforms_within: float
    """Largest distance of a face from the bisector plane of its pair, as computed."""


def certify(
    trained: PolygonMesh,
    radii: Floats,
    generators: Floats,
    inside: NDArray[np.bool_],
    face_generators: Ints,
    threads: int = 1,
) -> Certificate:
    """The certificate of ``trained`` with sphere radii ``radii (V,)`` and ``generators (N, 3)``.

    ``inside (N,)`` has the labels of the generators, and ``face_generators (F, 2)`` the inside and
    the outside generator of each face. All lengths are in model units.
    """
    corner, face = trained.face_vertices, trained.corner_faces
    first, second = face_generators[:, 0], face_generators[:, 1]
    own = np.concatenate(
        [
            ((generators[index[face]] - trained.vertices[corner]) ** 2).sum(axis=1)
            - radii[corner] ** 2
            for index in (first, second)
        ]
    )
    tau = float(np.abs(own).max(initial=0.0))
    others = _other_powers(trained, radii, generators, face_generators, threads)
    margin = float(others.min(initial=REACH**2))
    area, normal, _ = face_frames(trained)
    way = generators[second] - generators[first]
    length = np.linalg.norm(way, axis=1)
    turned = int((np.einsum("ij,ij->i", way, normal) <= 0).sum())
    rings = int((~sound_rings(trained, area, normal)).sum()) + len(bad_edges(trained))
    rings += int((np.bincount(corner, minlength=1) == 2).sum())
    vertices, triangles, _ = fan_triangles(trained)
    wound = int((RayParity(vertices, triangles).winding(generators) != inside).sum())
    labels = inside[first] & ~inside[second]
    failed = {
        "incident": tau > TAU,
        "exclusion": margin < MARGIN,
        "rings": rings > 0,
        "orientation": turned > 0 or not bool(labels.all()),
        "winding": wound > 0,
    }
    return Certificate(
        holds=trained.face_count > 0 and not any(failed.values()),
        failed=tuple(name for name, bad in failed.items() if bad),
        incident_power=tau,
        margin=margin,
        intruders=int((others < MARGIN).sum()),
        bad_rings=rings,
        turned_faces=turned,
        wound_wrongly=wound,
        smallest_offset=0.5 * float(length.min(initial=np.inf)),
        conforms_within=tau / max(float(length.min(initial=np.inf)), np.finfo(float).tiny),
    )


def _other_powers(
    trained: PolygonMesh, radii: Floats, generators: Floats, face_generators: Ints, threads: int
) -> Floats:
    """The powers of generators to spheres that are not of their faces, up to a bound above MARGIN.

    The least power is among them if it is below REACH^2.
    """
    incident = (face_generators[trained.corner_faces] * trained.vertex_count).T
    own = np.unique((incident + trained.face_vertices).reshape(-1))
    used = np.unique(trained.face_vertices)
    centres, squares = trained.vertices[used], radii[used] ** 2
    # A ball of radius REACH holds a great many generators where the edges are short, so the search
    # starts near the spheres.
    reach = min(REACH, max(2 * MARGIN**0.5, NEAR * float(np.median(radii[used]))))
    while True:
        powers = []
        for point, ball in held(generators, centres, np.sqrt(squares + reach**2), threads):
            apart = without(point * trained.vertex_count + used[ball], own)
            point, ball = point[apart], ball[apart]
            powers.append(((generators[point] - centres[ball]) ** 2).sum(axis=1) - squares[ball])
        others = np.concatenate(powers)
        if len(others) or reach >= REACH:
            return others
        reach = min(REACH, 2 * reach)


def sound_rings(mesh: PolygonMesh, area: Floats, normal: Floats) -> NDArray[np.bool_]:
    """Whether each face is flat and convex, ``(F,)``: it turns left at every
    corner, and once in total."""
    face, here, after = mesh.corner_faces, mesh.face_vertices, mesh.next_vertices
    into = mesh.vertices[after] - mesh.vertices[here]
    out = into[mesh.next_corners]
    axis = normal[face]
    sine = np.einsum("ij,ij->i", np.cross(into, out), axis)
    turn = np.arctan2(sine, np.einsum("ij,ij->i", into, out))
    start = mesh.vertices[mesh.face_vertices[mesh.face_offsets[face]]]
    height = np.abs(np.einsum("ij,ij->i", mesh.vertices[here] - start, axis))
    bad_corner = (sine <= 0) | (height > PLANAR) | (here == after)
    sound = (area > 0) & (mesh.valences >= 3)
    sound[face[bad_corner]] = False
    total = np.bincount(face, turn, minlength=mesh.face_count)
    return np.asarray(sound & (np.abs(total - 2 * np.pi) < 1.0))
