"""The answers that every kind of input gives.

A new kind is a folder beside ``mesh`` and ``field`` with a subclass of Source, a line in
``resolve`` that recognises its files, and a test. No other module asks which kind a source is,
except where only one kind has an answer: shading and comparison with pictures need views, and the
paper's level-set loss needs a field.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.creases import Chain
from ..mesh.model_frame import ModelFrame
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..mesh.queries.true_surface import TrueSurface
from ..progress import Progress


@dataclass(frozen=True)
class MeasuredPoints:
    """The points that a surface was made of, ``points (N, 3)``."""

    points: Floats
    kept: NDArray[np.bool_]
    """Those that are no outliers, ``(N,)``."""
    spacing: float
    """The typical distance between neighbours."""


class Source(ABC):
    """A shape. All coordinates are the input's own."""

    name: str
    kind: str
    path: Path | None
    """The file it comes from; None for a built-in field."""
    threads: int = 1
    """How many threads may open and prepare it."""

    needs_torch = False
    """Whether derivatives of it are found by torch, which is large."""

    @property
    def options(self) -> frozenset[str]:
        """The options of stage classify that this kind of input understands."""
        return frozenset()

    def configure(self, values: Mapping[str, Any]) -> None:
        """Take the values of all options of stage classify, before anything else is called.

        It must be quick and may be called again, since the memory is estimated after it and
        checked before ``prepare``.
        """
        return

    def prepare(self, progress: Progress) -> None:
        """Do what takes long, and report how far it is."""
        return

    def extra_memory(self) -> float:
        """What stage classify needs for this input beside the voxels, in MB."""
        return 0.0

    @abstractmethod
    def bounding_box(self) -> Floats:
        """A box ``(2, 3)`` that holds the shape: lower corner, upper corner."""

    @property
    def box_is_tight(self) -> bool:
        """Whether the surface touches all sides of the bounding box."""
        return True

    @abstractmethod
    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""

    @abstractmethod
    def may_cross(self, origin: Floats, edge: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The cells of a grid, ``shape``, that may be inside in part; all others are in or out."""

    @abstractmethod
    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        """``count`` points on the surface, uniform by area, ``(count, 3)``."""

    @abstractmethod
    def true_surface(self, frame: ModelFrame, threads: int) -> TrueSurface:
        """The surface in model units, found by up to ``threads`` threads."""

    @abstractmethod
    def exact_creases(self, frame: ModelFrame, angle: float) -> list[Chain]:
        """Where the input itself turns by ``angle`` degrees or more, in model units."""

    @abstractmethod
    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """Those, and creases of its true ``surface`` that are rounded or under noise."""

    @property
    def open_edges(self) -> int:
        """Number of edges that keep the input from being closed."""
        return 0

    def topology(self) -> tuple[int, int] | None:
        """Euler number, pinched vertices split, and number of components, where they are known."""
        return None

    def manifold(self) -> PolygonMesh:
        """A closed surface of that topology, where it is known. Raises TypeError elsewhere."""
        raise TypeError(f"the topology of an input of kind {self.kind} is not known")

    def given_polygons(self) -> PolygonMesh | None:
        """The polygons of an input that consists of them."""
        return None

    def triangulated(self) -> tuple[Floats, Ints] | None:
        """Vertices ``(V, 3)`` and triangles ``(T, 3)`` of the surface, where there are any."""
        return None

    def measured_points(self) -> MeasuredPoints | None:
        """The points of an input that consists of them."""
        return None

    @property
    def noise(self) -> float:
        """Standard deviation of measured points about the surface."""
        return 0.0

    def median_edge_length(self) -> float | None:
        """``h_ref`` of the paper's curvature metric, where the input has edges of its own."""
        return None

    def mean_curvature(self, points: Floats) -> Floats | None:
        """The exact mean curvature ``(N,)`` at ``points (N, 3)`` of the surface, where there is a
        formula for it."""
        return None

    def value(self, points: Floats) -> Floats | None:
        """The function ``F (N,)`` whose zero set is the surface, at ``points (N, 3)``, where the
        input is one."""
        return None

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What was understood of the input, for the manifest."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Arrays that classify stores because they took long to find."""

    @abstractmethod
    def restore(self, stored: Mapping[str, Any]) -> None:
        """Take the arrays that ``state`` returned for the same input."""

    @abstractmethod
    def warnings(self) -> list[str]:
        """What the user should know about this input."""

    def remarks(self) -> list[str]:
        """What the user should know when the input is a reference that others are compared with."""
        return []
