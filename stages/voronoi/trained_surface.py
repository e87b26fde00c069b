"""The trained surface: polygons, the spheres at their vertices, and their pairs of generators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.model_frame import ModelFrame
from ..mesh.polygons import Floats, Ints, PolygonMesh
from .certificate import Certificate, certify
from .diagram.interface import VoronoiSurface, interface


@dataclass(frozen=True)
class TrainedSurface:
    """V spheres and F faces with their generators, in model units (h0 is 1)."""

    polygons: PolygonMesh
    """The faces. Their vertices are the centres c_v of the spheres, ``(V, 3)``."""
    radii: Floats
    """The radii r_v of the spheres, ``(V,)``."""
    inside: Floats
    """The inside generator of each face, ``(F, 3)``."""
    outside: Floats
    """The outside generator of each face, ``(F, 3)``."""
    offsets: Floats
    """delta_f, half the distance of the pair, ``(F,)``; negative where the labels were swapped."""
    spacing: Floats
    """The local edge length at each face, ``(F,)``."""

    @classmethod
    def stored(cls, arrays: Mapping[str, Any], frame: ModelFrame) -> TrainedSurface:
        """The surface from the arrays that the sphere-train stage wrote."""
        polygons = PolygonMesh.from_arrays(arrays, "trained/")
        return cls(
            polygons.with_vertices(frame.model_from_input(polygons.vertices)),
            arrays["spheres/radius"] / frame.spacing,
            frame.model_from_input(arrays["generators/inside"]),
            frame.model_from_input(arrays["generators/outside"]),
            arrays["trained/offset"] / frame.spacing,
            arrays["spacing"] / frame.spacing,
        )

    def as_arrays(self, frame: ModelFrame) -> dict[str, Any]:
        """The arrays to store, in the unit of the input."""
        centres = frame.input_from_model(self.polygons.vertices)
        return {
            "spheres/center": centres,
            "spheres/radius": frame.spacing * self.radii,
            **self.polygons.with_vertices(centres).as_arrays("trained/"),
            "trained/offset": frame.spacing * self.offsets,
            "generators/inside": frame.input_from_model(self.inside),
            "generators/outside": frame.input_from_model(self.outside),
            "spacing": frame.spacing * self.spacing,
        }

    @property
    def face_count(self) -> int:
        return self.polygons.face_count

    @cached_property
    def generators(self) -> Floats:
        """All generators ``(2F, 3)``: f is the inside one of face f, and F + f the outside one."""
        return np.concatenate([self.inside, self.outside])

    @cached_property
    def labels(self) -> NDArray[np.bool_]:
        """Whether each generator is inside, ``(2F,)``."""
        return np.arange(2 * self.face_count) < self.face_count

    @cached_property
    def pairs(self) -> Ints:
        """The indices of the inside and the outside generator of each face, ``(F, 2)``."""
        number = np.arange(self.face_count)
        return np.stack([number, self.face_count + number], axis=1)

    @cached_property
    def faces_of_generators(self) -> Ints:
        """The face of each generator, ``(2F,)``."""
        return np.arange(2 * self.face_count) % self.face_count

    def interface(self) -> VoronoiSurface:
        """The interface of the generators in their Voronoi diagram."""
        return interface(self.generators, self.labels)

    def certificate(self, threads: int, inner: Floats | None = None) -> Certificate:
        """The certificate, with ``inner (N, 3)`` as further inside generators."""
        more = np.zeros((0, 3)) if inner is None else inner
        return certify(
            self.polygons,
            self.radii,
            np.concatenate([more, self.generators]),
            np.concatenate([np.ones(len(more), dtype=bool), self.labels]),
            len(more) + self.pairs,
            threads,
        )
