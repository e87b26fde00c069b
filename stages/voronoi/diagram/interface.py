"""The interface of a Voronoi diagram: the faces between inside and outside cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh.geometry import component_volumes
from ...mesh.polygons import PolygonMesh
from ...mesh.topology import face_components
from .delaunay import Floats, Ints, Tetrahedra, delaunay
from .rings import Rings, ring_mesh, select_interface, voronoi_rings
from .vertices import circumcentres


@dataclass(frozen=True)
class VoronoiSurface:
    """Faces of a Voronoi diagram, and the generators that they come from.

    ``generators (F, 2)`` are the two generators of each face; in an interface the inside one comes
    first. ``tetrahedra (V, 4)`` are the four generators of each vertex. ``flatness (V,)`` is 0 if
    these lie in one plane; the vertex then has no meaningful position.
    """

    mesh: PolygonMesh
    generators: Ints
    tetrahedra: Ints
    flatness: Floats


def rings_to_surface(generators: Floats, tetrahedra: Tetrahedra, rings: Rings) -> VoronoiSurface:
    """The faces ``rings``, with a vertex at the circumcentre of each tetrahedron that they use."""
    mesh, used = ring_mesh(rings)
    corners = tetrahedra.corners[used]
    positions, flatness = circumcentres(generators, corners)
    return VoronoiSurface(mesh.with_vertices(positions), rings.generators, corners, flatness)


def interface(
    generators: Floats, inside: NDArray[np.bool_], tetrahedra: Tetrahedra | None = None
) -> VoronoiSurface:
    """The interface of ``generators (N, 3)`` with labels ``inside (N,)``, with outward normals.

    It is closed by construction: an edge of it is dual to a Delaunay triangle with both labels, and
    exactly two of the three edges of such a triangle join different labels.
    """
    diagram = delaunay(generators) if tetrahedra is None else tetrahedra
    rings = voronoi_rings(generators, diagram, select_interface(inside))
    return rings_to_surface(generators, diagram, rings)


def without_islands(
    generators: Floats, inside: NDArray[np.bool_], smallest: float
) -> tuple[Floats, NDArray[np.bool_], int]:
    """Remove generators that only make components with a volume below ``smallest``.

    Such a component is a small piece outside that comes from inside generators, or a small bubble
    inside that comes from outside ones. Both are smaller than the generators can resolve. Returns
    the remaining generators and labels, and the number of components that were removed.
    """
    gone = 0
    while True:
        surface = interface(generators, inside)
        count, component = face_components(surface.mesh)
        volumes = component_volumes(surface.mesh, component, count)
        small = np.abs(volumes) < smallest
        if not small.any() or small.all():
            return generators, inside, gone
        gone += int(small.sum())
        enclosed = np.where(volumes[component] > 0, 0, 1)
        touched = surface.generators[np.arange(len(component)), enclosed][small[component]]
        keep = np.ones(len(generators), dtype=bool)
        keep[touched] = False
        generators, inside = generators[keep], inside[keep]
