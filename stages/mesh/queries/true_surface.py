"""The protocol of a true surface: closest points, samples with normals, inside or outside."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..polygons import Floats

SAMPLES = 10_000
"""Number of samples of the surface at which thickness and tips are measured."""


class NearSurface(Protocol):
    """A surface whose closest points are known. Training pulls vertices to these."""

    samples: Floats
    normals: Floats
    """Outward unit normals at ``samples``. Both are ``(S, 3)``."""

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """The closest surface points ``(N, 3)``, and the outward unit normals there.

        With ``normals (N, 3)``, points whose normal opposes the given one are avoided where others
        exist.
        """
        ...


class TrueSurface(NearSurface, Protocol):
    """The surface of a solid: it also says what is inside. Lengths are in units of h0.

    Generators are mirrored in this surface.
    """

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""
        ...
