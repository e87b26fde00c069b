"""``vorolight export``: the cells of a run in other programs' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.errors import ArtifactError

from . import completion
from .session import Quiet, Run, Verbose

FORMATS = (
    "vtu|openfoam|ovm|vtu-tetrahedra|msh|inp|ply|hdf5|graph-csv|graph-hdf5|pflotran|tough|modflow"
)


def export(
    target: Annotated[
        Path,
        typer.Argument(
            help="The file to write (.vtu, .ovm, .msh, .inp, .ply or .h5), or a folder."
        ),
    ],
    run: Run = None,
    format: Annotated[
        str | None,
        typer.Option(
            help=f"File format [{FORMATS}]. Default: by the suffix. openfoam, graph-csv, "
            "pflotran, tough and modflow write a folder.",
            autocompletion=completion.choices(lambda: FORMATS.split("|")),
            show_default=False,
        ),
    ] = None,
    cut: Annotated[
        str | None,
        typer.Option(
            help="Keep only the cells whose generators lie below a plane (x=0.1) or above it "
            "(x>0.1); y and z work too.",
            show_default=False,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write the cells of stage volume for other programs.

    Example: vorolight export case --format openfoam --run bunny.vorolight
    """
    from vorolight.stages.engine import freshness
    from vorolight.stages.engine.export import export as write
    from vorolight.stages.engine.export import format_of
    from vorolight.stages.engine.session import Session

    form = format_of(target, format)
    folder = RunFolder.locate(run, None)
    for found in freshness.overall(Session(folder=folder)):
        if found.stage.name == "volume" and found.manifest is not None and found.reason:
            raise ArtifactError(
                f"{folder.path}: the cells are stale ({found.reason}); run: vorolight volume"
            )
    written = write(folder, target, form, cut, force)
    if not quiet:
        print(f"{target}: {written}")
