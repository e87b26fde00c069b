"""The certificate: a trained surface equals the interface of its generators' Voronoi diagram.

In exact arithmetic it does if

1. ``incident``: every generator lies on the spheres of its face's corners;
2. ``exclusion``: no generator lies inside any other sphere;
3. ``rings``: each face is a convex planar polygon of nonzero area, every edge is in two faces with
   opposite directions, every vertex in three faces or more;
4. ``orientation``: each face's normal points from its inside to its outside generator;
5. ``winding``: the surface winds once around every inside generator, and around no outside one.

Differences of powers are affine on a face, so by 1 and 2 each face lies in the Voronoi face of its
pair, and no open cell crosses the surface; by 4 and 5 there is no other interface.
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
"""Largest ``|power|`` of a face's generator to a sphere of its corners, in units of h0^2."""
MARGIN = 1e-5
"""Smallest power of another generator, in units of h0^2."""
PLANAR = 1e-8
"""Largest distance of a corner from its face's plane, in units of h0."""
REACH = 0.5
"""Distance beyond a sphere, in units of h0, within which generators are measured."""
NEAR = 0.2
"""The distance of the first search, in median radii."""


@dataclass(frozen=True)
class Certificate:
    """The result of the checks; lengths are in units of h0."""

    holds: bool
    failed: tuple[str, ...]
    """The conditions that fail: incident, exclusion, rings, orientation, winding."""
    incident_power: float
    """tau: the largest ``|power|`` of a face's generator to the spheres of its corners."""
    margin: float
    """m: the smallest power of a generator to a sphere that is not one of its face's, at most
    REACH^2."""
    intruders: int
    """Pairs of a generator and a sphere that is not one of its face's, with a power below the
    margin."""
    bad_rings: int
    """Faces that are not convex, planar or solid, and edges that are not in two faces."""
    turned_faces: int
    wound_wrongly: int
    """Generators on the wrong side of the surface."""
    smallest_offset: float
    """The smallest of half the distance between the two generators of a face."""
    conforms_within: float
    """Largest distance of a face from the bisector of its pair, in floating point."""


def certify(
    trained: PolygonMesh,
    radii: Floats,
    generators: Floats,
    inside: NDArray[np.bool_],
    face_generators: Ints,
    threads: int = 1,
) -> Certificate:
    """Check ``trained`` with spheres ``radii (V,)`` against ``generators (N, 3)``.

    ``inside (N,)`` are their labels, ``face_generators (F, 2)`` the inside and the outside one of
    each face. All in model units.
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
    """Powers of generators in or near a sphere that is not one of their face's spheres: all of them
    up to some bound above MARGIN, the least of them among these if it is below REACH^2."""
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
    """Faces that are planar and convex: they turn left at every corner, and once around in
    total."""
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
