"""The true surface of a shape: closest points, samples with normals, inside."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..polygons import Floats

SAMPLES = 10_000
"""Points that stand for the surface where its thickness and its tips are looked for."""


class NearSurface(Protocol):
    """What vertices are drawn to."""

    samples: Floats
    normals: Floats
    """Outward unit normals at ``samples``, both ``(S, 3)``."""

    def closest(self, points: Floats, normals: Floats | None = None) -> tuple[Floats, Floats]:
        """The closest surface points ``(N, 3)`` and the outward unit normals there.

        With ``normals (N, 3)`` only points whose normal does not oppose them, where there are any.
        """
        ...


class TrueSurface(NearSurface, Protocol):
    """What generators are mirrored in too. Lengths in units of h0."""

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each of ``points (N, 3)`` is inside."""
        ...
