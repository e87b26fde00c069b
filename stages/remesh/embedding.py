"""Changes of a triangle surface that do not make it cross itself."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats, Ints
from ..mesh.queries.intersections import self_intersections

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..mesh.edge_table import Sized

ROUNDS = 6
"""Number of rounds in which vertices of crossing triangles are put back,
each with one more ring."""


def kept_embedded(before: Floats, after: Floats, triangles: Ints) -> Floats:
    """``after (V, 3)``, with vertices put back to ``before`` where triangles would newly cross.

    If triangles still cross after ROUNDS rounds, all vertices are put back.
    """
    # Only triangles that move can newly cross others.
    moved = (after != before).any(axis=1)[triangles].any(axis=1)
    crossing = self_intersections(after, triangles, moved)
    if len(crossing) == 0:
        return after
    count = len(triangles)
    known = self_intersections(before, triangles, moved) @ np.array([count, 1])
    for rings in range(ROUNDS):
        new = crossing[~np.isin(crossing @ np.array([count, 1]), known)]
        if len(new) == 0:
            return after
        back = np.zeros(len(before), dtype=bool)
        back[triangles[new.reshape(-1)]] = True
        for _ in range(rings):
            back[triangles[back[triangles].any(axis=1)]] = True
        after = np.where(back[:, None], before, after)
        crossing = self_intersections(after, triangles, moved)
    return before


def embedded(
    change: Callable[[Sized, NDArray[np.bool_]], int], mesh: Sized, where: NDArray[np.bool_]
) -> None:
    """Apply ``change`` at the vertices ``where (V,)``, except where triangles would newly cross.

    If leaving out those places does not help, nothing is changed. The change may remove vertices,
    but must not add any.
    """
    known = len(self_intersections(mesh.vertices, mesh.triangles))
    number = np.arange(len(mesh.vertices), dtype=np.float64)
    where = where.copy()
    for _ in range(ROUNDS):
        trial = replace(
            mesh, vertices=mesh.vertices.copy(), length=mesh.length.copy(),
            carried=np.column_stack([mesh.carried, number]),
        )  # fmt: skip
        if not change(trial, where):
            return
        crossing = self_intersections(trial.vertices, trial.triangles)
        if len(crossing) <= known:
            trial.carried = trial.carried[:, :-1]
            for item in fields(trial):
                setattr(mesh, item.name, getattr(trial, item.name))
            return
        at = np.zeros(len(where), dtype=bool)
        at[trial.carried[trial.triangles[crossing.reshape(-1)], -1].astype(int)] = True
        at[mesh.triangles[at[mesh.triangles].any(axis=1)]] = True
        where &= ~at
