"""The surface of a Voronoi diagram: the faces between inside and outside cells."""

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
    """Polygons of a Voronoi diagram and where they come from.

    ``generators (F, 2)`` are the two generators of each face (inside first for an interface),
    ``tetrahedra (V, 4)`` the four generators of each vertex, ``flatness (V,)`` how far those are
    from lying in one plane (0 = flat: the position means nothing).
    """

    mesh: PolygonMesh
    generators: Ints
    tetrahedra: Ints
    flatness: Floats


def rings_to_surface(generators: Floats, tetrahedra: Tetrahedra, rings: Rings) -> VoronoiSurface:
    """Number the tetrahedra that ``rings`` use and place a vertex at each circumcentre."""
    mesh, used = ring_mesh(rings)
    corners = tetrahedra.corners[used]
    positions, flatness = circumcentres(generators, corners)
    return VoronoiSurface(mesh.with_vertices(positions), rings.generators, corners, flatness)


def interface(
    generators: Floats, inside: NDArray[np.bool_], tetrahedra: Tetrahedra | None = None
) -> VoronoiSurface:
    """The raw in/out interface of the diagram of ``generators (N, 3)``, outward normals.

    Closed by construction: an interface edge is a Delaunay triangle with both labels, and exactly
    two of its three edges join opposite labels.
    """
    diagram = delaunay(generators) if tetrahedra is None else tetrahedra
    rings = voronoi_rings(generators, diagram, select_interface(inside))
    return rings_to_surface(generators, diagram, rings)


def without_islands(
    generators: Floats, inside: NDArray[np.bool_], smallest: float
) -> tuple[Floats, NDArray[np.bool_], int]:
    """Remove generators whose only effect are specks: components that enclose less than
    ``smallest``.

    A speck in the outside comes from inside generators, a bubble in the inside from outside ones.
    Both are smaller than the generators can resolve. Returns the remaining generators and labels,
    and the number of components that were removed.
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
