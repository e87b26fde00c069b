"""Closed surfaces as exact solids of manifold3d."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import NumericalFailure
from .geometry import fan_triangles
from .polygons import PolygonMesh


def solid_of(surface: PolygonMesh) -> Any:
    """The solid inside a closed surface.

    Raises NumericalFailure if manifold3d accepts no solid, because the surface is not closed or is
    empty.
    """
    from manifold3d import Manifold, Mesh64

    vertices, triangles, _ = fan_triangles(surface)
    solid = Manifold(Mesh64(vertices, triangles.astype(np.uint64)))
    if solid.status().name != "NoError" or solid.is_empty():
        raise NumericalFailure(f"the surface makes no solid ({solid.status().name})")
    return solid
