"""Stage classify: find the voxels that lie inside the shape.

Example:
    >>> from pathlib import Path
    >>> from vorolight.stages import classify
    >>> from vorolight.stages.artifacts.run_folder import RunFolder
    >>> from vorolight.stages.engine.runner import execute
    >>> from vorolight.stages.engine.session import Session
    >>> from vorolight.stages.inputs.resolve import identify
    >>> session = Session(RunFolder(Path("heart.vorolight")), identify("heart"))
    >>> result = execute(session, "classify", classify.Params(n_init=25))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from .engine.params import Positive, Range, Short, StageParams
from .engine.stage import Context, Outcome, Stage
from .errors import InputError, UsageError
from .memory import peak
from .sphere_train_params import DEFAULTS, MAX_FACES

if TYPE_CHECKING:
    from .inputs.effort import Effort
    from .inputs.source import Source
    from .mesh.model_frame import ModelFrame


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the classify stage."""

    n_init: Annotated[int, Range(5, 512), Short("-n")] = 25
    """Number of voxels along the longest side of the shape. It sets the resolution of all
    stages."""
    noise: Positive | None = None
    """Standard deviation of the noise of a point cloud, in the unit of the input. Default:
    estimated."""
    columns: str | None = None
    """The columns of a text file that hold x, y and z, and optionally the normal, by name or by
    number, counted from 1: 2,3,4. Default: the columns with these names, else the first ones."""
    level: float | None = None
    """Samples on a grid above this value are inside, as for a CT scan. Default: negative samples
    are inside, and of labels those that are not zero."""
    mask_votes: Annotated[int, Range(0, 100)] = 0
    """How many masks of views may be wrong about a place that is inside."""
    background: str | None = None
    """Background colour of opaque views without masks: auto, white, black, or red, green and blue,
    as in 0,177,64. It is removed from the border of each picture inward. Default: auto, the colour
    of most of the border."""
    enclosed: Literal["object", "background"] = "object"
    """What areas of the background colour inside the object are in such views: parts of the object,
    or background that is seen through openings."""
    invert_masks: bool = False
    """Invert masks or alpha channels of views in which the object is dark."""
    repair: bool = False
    """Repair a mesh with pymeshlab first: remove doubled and non-manifold parts, turn faces and
    close holes."""
    weld: Positive | None = None
    """Merge vertices of open edges of a mesh within this distance, in the unit of the input; 0
    merges only those at the same place. Default: those that single precision cannot tell apart."""
    allow_poor_input: bool = False
    """Continue with a mesh most of whose edges are open and whose inside is uncertain, or with a
    shape so thin that its surface needs more than 400,000 triangles. With --thickness a mesh is a
    sheet, whatever its edges are."""
    max_time: Annotated[float, Range(0)] | None = None
    """Refuse a shape whose run up to the surface would take about more CPU seconds than this."""
    shells: Literal["union", "alternate"] = "union"
    """Closed parts of a mesh inside each other that all face outward: union makes them one solid,
    alternate makes every second one a hollow."""
    thickness: Positive | None = None
    """Thickness with which a mesh becomes a sheet, in the unit of the input; 0 makes it a solid.
    Default: a solid, or a sheet of one voxel if the mesh encloses next to nothing."""


NEEDS = {
    "noise": "a point cloud",
    "columns": "a point cloud",
    "level": "samples on a grid",
    "mask_votes": "views",
    "invert_masks": "views",
    "background": "views",
    "enclosed": "views",
    "thickness": "a mesh",
    "weld": "a mesh",
    "shells": "a mesh",
    "repair": "a mesh",
}
"""What the options are for that only some kinds of input know."""


def run(context: Context) -> Outcome:
    """Sample every voxel 35 times, in two passes (paper's appendix C.1)."""
    from .inputs import classification
    from .inputs.effort import effort
    from .inputs.thin import thin_parts
    from .mesh.model_frame import ModelFrame

    source, params = _configured(context), context.params
    source.prepare(context.progress)
    context.progress.start("classify", 2 * classification.ROUNDS)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        context.progress.advance(done)

    grid = classification.classify(source, params.n_init, context.random, tick)
    low, high = source.bounding_box()
    thin = thin_parts(source, grid, context.threads)
    # A surface that is known is trained from its own triangles, which lose nothing.
    lost = None if source.topology() else thin.warning()
    needed = effort(source, grid, DEFAULTS["triangle"]["edge_length"])
    frame = ModelFrame(grid.origin, grid.spacing)
    _check_effort(needed, params, str(source.path or source.name), frame)
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
            "effort": needed.facts(),
        },
        warnings=source.warnings() + ([lost] if lost else []),
        frame={
            "unit": "input",
            "input_from_model": [[float(i == j) for j in range(4)] for i in range(4)],
            "bounding_box": [low.tolist(), high.tolist()],
        },
    )


def _check_effort(needed: Effort, params: Params, name: str, frame: ModelFrame) -> None:
    """Raise InputError if the run would need too many triangles, or too much time."""
    refused = needed.refusal(MAX_FACES, frame)
    if refused is not None and not params.allow_poor_input:
        raise InputError(f"{name}: {refused}")
    if params.max_time is not None and needed.cpu_seconds > params.max_time:
        raise InputError(
            f"{name}: the run up to the surface takes about {needed.cpu_seconds:.0f} CPU seconds "
            f"for {needed.triangles:,} triangles, more than --max-time {params.max_time:g}: raise "
            "it, or lower -n"
        )


def _configured(context: Context) -> Source:
    """The input, with the options that are for it. Raises UsageError for an option that this kind
    of input does not know."""
    source, params = context.source(), context.params
    for name, needed in NEEDS.items():
        default = getattr(Params, name)
        if getattr(params, name) != default and name not in source.options:
            raise UsageError(
                f"--{name.replace('_', '-')}: needs {needed}, but the input is of kind "
                f"{source.kind}"
            )
    source.threads = context.threads
    source.configure(vars(params))
    return source


def _memory(context: Context) -> float:
    source = _configured(context)
    libraries = 290.0
    voxels = peak(libraries, libraries, 0.25, float(context.params.n_init) ** 3)
    return voxels + source.extra_memory()


STAGE = Stage(
    name="classify",
    version=9,
    params=Params,
    run=run,
    memory=_memory,
)
