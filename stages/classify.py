"""Stage classify: which voxels are inside the shape, which lie in the band around it.

Example:
    >>> from pathlib import Path
    >>> from vorolight.stages import classify, pipeline, standing
    >>> from vorolight.stages.artifacts.run_folder import RunFolder
    >>> from vorolight.stages.sources.resolve import identify
    >>> session = standing.Session(RunFolder(Path("heart.vorolight")), identify("heart"))
    >>> result = pipeline.execute(session, "classify", classify.Params(n_init=25))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from . import contract
from .contract import Context, Outcome, Range, Short, Stage
from .memory import peak


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the classify stage."""

    n_init: Annotated[int, Range(5, 512), Short("-n")] = 25
    """Voxels along the longest side of the shape: the resolution of everything that follows."""


def run(context: Context) -> Outcome:
    """Sample every voxel 35 times, in two passes (paper's appendix C.1)."""
    from .sources import voxels

    source = context.source()
    context.progress.start("classify", 2 * voxels.ROUNDS)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        context.progress.advance(done)

    grid = voxels.classify(source, context.params.n_init, context.random, tick)
    low, high = source.bounding_box()
    return Outcome(
        arrays={
            "origin": grid.origin,
            "spacing": grid.spacing,
            "interior": grid.interior,
            "exterior": grid.exterior,
        },
        metrics={
            "input": source.describe(),
            "spacing": grid.spacing,
            "interior_voxels": int(grid.interior.sum()),
            "exterior_voxels": int(grid.exterior.sum()),
        },
        warnings=source.warnings(),
        frame={
            "unit": "input",
            "input_from_model": [[float(i == j) for j in range(4)] for i in range(4)],
            "bounding_box": [low.tolist(), high.tolist()],
        },
    )


STAGE = Stage(
    name="classify",
    version=3,
    params=Params,
    run=run,
    memory=lambda context: peak(240.0, 240.0, 0.25, float(context.params.n_init) ** 3),
)
