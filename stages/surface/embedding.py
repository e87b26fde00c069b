"""Moves of vertices that keep a triangle surface from crossing itself."""

from __future__ import annotations

import numpy as np

from ..metrics.intersections import self_intersections
from .polygons import Floats, Ints

ROUNDS = 6
"""How often vertices of crossing triangles, and each time a ring more, are put back."""


def kept_embedded(before: Floats, after: Floats, triangles: Ints) -> Floats:
    """``after (V, 3)``, with vertices back ``before`` where triangles cross that did not.

    Where that does not help in ROUNDS rounds all of them are put back: what was embedded stays so.
    """
    crossing = self_intersections(after, triangles)
    if len(crossing) == 0:
        return after
    count = len(triangles)
    known = self_intersections(before, triangles) @ np.array([count, 1])
    for rings in range(ROUNDS):
        new = crossing[~np.isin(crossing @ np.array([count, 1]), known)]
        if len(new) == 0:
            return after
        back = np.zeros(len(before), dtype=bool)
        back[triangles[new.reshape(-1)]] = True
        for _ in range(rings):
            back[triangles[back[triangles].any(axis=1)]] = True
        after = np.where(back[:, None], before, after)
        crossing = self_intersections(after, triangles)
    return before
