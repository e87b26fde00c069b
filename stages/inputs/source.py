"""What every kind of input answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..mesh.creases import Chain
from ..mesh.model_frame import ModelFrame
from ..mesh.polygons import Floats, PolygonMesh
from ..mesh.queries.true_surface import TrueSurface


class Source(Protocol):
    """A shape. All coordinates are the input's own."""

    @property
    def name(self) -> str: ...

    @property
    def kind(self) -> str: ...

    @property
    def path(self) -> Path | None:
        """The file it comes from; None for a built-in field."""
        ...

    def bounding_box(self) -> Floats:
        """A box ``(2, 3)`` that holds the shape: lower corner, upper corner."""
        ...

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""
        ...

    def may_cross(self, origin: Floats, edge: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The cells of a grid, ``shape``, that may be inside in part; all others are in or out."""
        ...

    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        """``count`` points on the surface, uniform by area, ``(count, 3)``."""
        ...

    def true_surface(self, frame: ModelFrame, threads: int) -> TrueSurface:
        """The surface in model units, found by up to ``threads`` threads."""
        ...

    def exact_creases(self, frame: ModelFrame, angle: float) -> list[Chain]:
        """Where the input itself turns by ``angle`` degrees or more, in model units."""
        ...

    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """Those, and creases of its true ``surface`` that are rounded or under noise."""
        ...

    def topology(self) -> tuple[int, int] | None:
        """Euler number, pinched vertices split, and number of components, where they are known."""
        ...

    def manifold(self) -> PolygonMesh:
        """A closed surface of that topology, where it is known. Raises TypeError elsewhere."""
        ...

    def describe(self) -> dict[str, Any]:
        """What was understood of the input, for the manifest."""
        ...

    def state(self) -> dict[str, Any]:
        """Arrays that classify stores because they took long to find."""
        ...

    def warnings(self) -> list[str]:
        """What the user should know about this input."""
        ...
