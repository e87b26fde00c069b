"""The options that every stage command has, and the session they make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import registry
from vorolight.stages.engine.session import Session, available_threads
from vorolight.stages.errors import UsageError

from . import completion
from .console import Console
from .parameters import read_config

if TYPE_CHECKING:
    from vorolight.stages.inputs.resolve import Identity

Input = Annotated[
    str | None,
    typer.Argument(
        help="The shape: a mesh, a point cloud, views (a folder or transforms.json), a built-in "
        "field (heart, sphere, torus, genus-two, gyroid, cube-cavity), a formula, or samples on a "
        "grid (.npy, .npz, .nrrd, .mha, .nii, .vti). Files may be packed (.gz).",
        autocompletion=completion.input_field,
    ),
]
Field = Annotated[
    str | None,
    typer.Option(
        "--field",
        help="A field in place of INPUT: a formula in x, y and z that is negative inside, such as "
        "'x**2+y**2+z**2-1', or a Python function MODULE:FUNCTION.",
    ),
]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Allow a MODULE:FUNCTION to be imported and run.")
]
Kind = Annotated[
    str | None,
    typer.Option(
        "--kind",
        help="The kind of INPUT [mesh|points|field|views]. Default: recognised from the file.",
        autocompletion=completion.choices(completion.kinds),
        show_default=False,
    ),
]
Run = Annotated[
    Path | None,
    typer.Option(
        "--run",
        envvar="VOROLIGHT_RUN",
        help="The run folder. Default: the name of INPUT with the suffix .vorolight.",
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(
        help="Seed of all random numbers. Default: 0.", min=0, max=2**63, show_default=False
    ),
]
Threads = Annotated[int | None, typer.Option(help="Threads to use. Default: all.", min=1, max=1024)]
DEVICES = ("cpu", "cuda")
Device = Annotated[
    str,
    typer.Option(
        help="Where torch computes [cpu|cuda].",
        autocompletion=completion.choices(lambda: DEVICES),
    ),
]
Backend = Annotated[
    str,
    typer.Option(
        help="Library for the Delaunay diagrams of iterations [scipy|shull].",
        autocompletion=completion.choices(completion.backends),
    ),
]
MaxMemory = Annotated[
    float | None,
    typer.Option(
        help="Memory in GB that a stage may need; a stage that needs more is refused. Default: the "
        "free memory.",
        min=0.01,
        max=1e6,
        show_default=False,
    ),
]
Force = Annotated[
    bool, typer.Option("--force", help="Run again although the result is up to date.")
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print what would run and why, and do nothing.")
]
Touch = Annotated[
    bool, typer.Option("--touch", help="Set the manifest's time to now if it is up to date.")
]
Verify = Annotated[
    bool,
    typer.Option("--verify", help="Compare the contents of all files with the recorded checksums."),
]
Json = Annotated[bool, typer.Option("--json", help="Print the manifest as JSON on stdout.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print no progress and no summary.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Print more, including tracebacks.")]
NoColor = Annotated[bool, typer.Option("--no-color", help="Print without colours.")]
Config = Annotated[
    Path | None, typer.Option("--config", help="TOML file with a table of options per stage.")
]


@dataclass(frozen=True)
class Common:
    """The options every stage command has."""

    console: Console
    session: Session
    seed: int | None
    """As given; the session has 0 if none was given."""
    dry_run: bool
    config: dict[str, dict[str, Any]]


def identity_of(input: str | None, field: str | None, kind: str | None = None) -> Identity | None:
    """The given input, if any. Raises UsageError if two are given, InputError for an unusable
    one."""
    from vorolight.stages.inputs.resolve import KINDS, identify, identify_field

    if kind is not None and kind not in KINDS:
        raise UsageError(f"--kind {kind}: must be one of {', '.join(KINDS)}")
    if kind is not None and input is None:
        raise UsageError("--kind: there is no INPUT that it could describe; give an INPUT")
    if input is not None and field is not None:
        raise UsageError(f"--field and INPUT {input}: both are given; give one of them")
    if field is not None:
        return identify_field(field)
    return None if input is None else identify(input, kind)


def common_options(
    input: Input = None,
    field: Field = None,
    kind: Kind = None,
    allow_code: AllowCode = False,
    run: Run = None,
    seed: Seed = None,
    threads: Threads = None,
    device: Device = "cpu",
    backend: Backend = "scipy",
    max_memory: MaxMemory = None,
    force: Force = False,
    dry_run: DryRun = False,
    touch: Touch = False,
    verify: Verify = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    no_color: NoColor = False,
    config: Config = None,
) -> Common:
    """The options of every stage command, besides the stage's own."""
    from vorolight.stages.voronoi.diagram.delaunay import BACKENDS

    if device not in DEVICES:
        raise UsageError(f"--device {device}: must be cpu or cuda")
    if backend not in BACKENDS:
        raise UsageError(f"--backend {backend}: must be {' or '.join(BACKENDS)}")
    console = Console(0 if quiet else 2 if verbose else 1, json, not no_color)
    identity = identity_of(input, field, kind)
    session = Session(
        folder=RunFolder.locate(run, None if identity is None else identity.stem),
        input=identity,
        seed=seed or 0,
        threads=threads or available_threads(),
        device=device,
        backend=backend,
        allow_code=allow_code,
        max_memory_mb=None if max_memory is None else 1000 * max_memory,
        force=force,
        touch=touch,
        verify=verify,
        progress=console,
    )
    return Common(console, session, seed, dry_run, read_config(config, registry.ALL))
