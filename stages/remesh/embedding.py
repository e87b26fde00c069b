"""Changes of a triangle surface that keep it from crossing itself."""

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
"""How often vertices of crossing triangles, and each time a ring more, are put back."""


def kept_embedded(before: Floats, after: Floats, triangles: Ints) -> Floats:
    """``after (V, 3)``, with vertices back ``before`` where triangles cross that did not.

    Where that does not help in ROUNDS rounds all of them are put back: what was embedded stays so.
    """
    # Only triangles that move cross others anew.
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
    """Make a ``change`` of edges ``where (V,)``, but for those around which triangles would cross,
    so that no more of them do than before; none at all where leaving these out does not help. The
    change may take vertices away; it adds none."""
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
