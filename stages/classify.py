"""Stage classify: find the voxels that lie inside the shape.

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
from typing import TYPE_CHECKING, Annotated, Literal, cast

from . import contract
from .contract import Context, Outcome, Positive, Range, Short, Stage
from .errors import UsageError
from .memory import peak

if TYPE_CHECKING:
    from .sources.images import ViewSource


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the classify stage."""

    n_init: Annotated[int, Range(5, 512), Short("-n")] = 25
    """Voxels along the longest side of the shape: the resolution of everything that follows."""
    noise: Positive | None = None
    """Standard deviation of a point cloud's noise, in the input's units; estimated by default."""
    columns: str | None = None
    """Of a text of points: which columns are x, y and z, and maybe the normal, by name or by number
    from 1 on, as in 2,3,4. By default those of these names, else the first."""
    level: float | None = None
    """Of samples on a grid: what is above this value is inside, as of a CT scan. By default what is
    negative is inside, of labels what is not zero."""
    mask_votes: Annotated[int, Range(0, 100)] = 0
    """Of views: how many masks may leave out what is inside, anywhere."""
    repair: bool = False
    """Let pymeshlab remove what is doubled or not manifold in a mesh, turn faces, close holes."""
    weld: Positive | None = None
    """Distance, in the input's units, within which vertices of a mesh's open edges are one; 0: only
    those at the same place. By default as near as single precision tells them apart."""
    allow_poor_input: bool = False
    """Go on with a mesh most of whose edges are open and whose inside is in doubt. With --thickness
    it is a sheet, and nothing is asked."""
    shells: Literal["union", "alternate"] = "union"
    """Of closed parts of a mesh within each other that all face outward: union takes them as one
    solid, alternate each second one as a hollow."""
    thickness: Positive | None = None
    """Take a mesh as a sheet this thick, in the input's units; 0: as a solid. By default a sheet
    of a voxel if it encloses next to nothing beyond doubt."""


def run(context: Context) -> Outcome:
    """Sample every voxel 35 times, in two passes (paper's appendix C.1)."""
    import numpy as np

    from .sources import voxels
    from .sources.fields import FieldSource
    from .sources.mesh import SHEET, MeshSource
    from .sources.points import PointSource
    from .sources.thin import thin_parts

    source = context.source()
    params = context.params
    if isinstance(source, PointSource):
        source.given_noise, source.threads = params.noise, context.threads
        source.columns = params.columns
    elif params.noise is not None:
        raise UsageError(f"--noise: the input is a {source.kind}; only points have noise")
    elif params.columns is not None:
        raise UsageError(f"--columns: the input is a {source.kind}; only points have columns")
    if isinstance(source, FieldSource) and source.path is not None:
        source.above = params.level
    elif params.level is not None:
        raise UsageError(f"--level: the input is a {source.kind}; only samples on a grid have one")
    if source.kind == "views":
        _fit(cast("ViewSource", source), context)
    elif params.mask_votes:
        raise UsageError(f"--mask-votes: the input is a {source.kind}; only views have masks")
    if isinstance(source, MeshSource):
        source.repair, source.reach = params.repair, params.weld
        source.hollow = params.shells == "alternate"
        thickness = params.thickness
        if thickness is None and not params.allow_poor_input:
            source.refuse_soup()
        if thickness is None and (source.flat or source.sureness < SHEET):
            thickness = float(np.ptp(source.bounding_box(), axis=0).max()) / params.n_init
        source.take_as_sheet(thickness or 0.0)
    elif params.thickness is not None:
        raise UsageError(f"--thickness: the input is a {source.kind}; only a mesh can be a sheet")
    elif params.weld is not None:
        raise UsageError(f"--weld: the input is a {source.kind}; only a mesh has vertices to weld")
    elif params.shells != "union":
        raise UsageError(f"--shells: the input is a {source.kind}; only a mesh has shells")
    elif params.allow_poor_input:
        raise UsageError(f"--allow-poor-input: the input is a {source.kind}, not a mesh")
    elif params.repair:
        raise UsageError(f"--repair: of {source.kind} there is nothing to repair; only of a mesh")
    context.progress.start("classify", 2 * voxels.ROUNDS)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        context.progress.advance(done)

    grid = voxels.classify(source, params.n_init, context.random, tick)
    low, high = source.bounding_box()
    thin = thin_parts(source, grid, context.threads)
    return Outcome(
        arrays={
            "origin": grid.origin,
            "spacing": grid.spacing,
            "interior": grid.interior,
            "exterior": grid.exterior,
            **source.state(),
        },
        metrics={
            "input": source.describe(),
            "spacing": grid.spacing,
            "interior_voxels": int(grid.interior.sum()),
            "exterior_voxels": int(grid.exterior.sum()),
            "thin_parts": vars(thin),
        },
        warnings=source.warnings() + [said for said in [thin.warning()] if said],
        frame={
            "unit": "input",
            "input_from_model": [[float(i == j) for j in range(4)] for i in range(4)],
            "bounding_box": [low.tolist(), high.tolist()],
        },
    )


def _fit(source: ViewSource, context: Context) -> None:
    """Make the surface that stands for views, with a progress of its own."""
    from .sources.view_fit import rounds

    source.votes, source.threads = context.params.mask_votes, context.threads
    context.progress.start("fit to the views", rounds())
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        context.progress.advance(done)

    source.tick = tick
    source.polygons  # noqa: B018
    context.progress.finish()


def _memory(context: Context) -> float:
    from .sources.points import PointSource

    source = context.source()
    voxels = peak(290.0, 290.0, 0.25, float(context.params.n_init) ** 3)
    if isinstance(source, PointSource):
        source.columns = context.params.columns
        return voxels + 350.0 + 3.5e-4 * len(source.cloud.points)
    if source.kind == "views":
        return voxels + 450.0 + 2e-5 * cast("ViewSource", source).views.masks.size
    return voxels


STAGE = Stage(
    name="classify",
    version=8,
    params=Params,
    run=run,
    memory=_memory,
)
