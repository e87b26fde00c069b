"""``vorolight compare``: several runs on one page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import freshness
from vorolight.stages.engine.session import Session
from vorolight.stages.errors import ArtifactError, UsageError

from .session import Quiet, Verbose


def outdated(folder: RunFolder) -> dict[str, str]:
    """Why existing results of a run are stale, by the names of their files."""
    return {
        found.stage.stem_of(found.params): found.reason
        for found in freshness.overall(Session(folder=folder))
        if found.manifest is not None and found.reason is not None
    }


def compare(
    runs: Annotated[list[Path], typer.Argument(help="Two or more run folders.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The page to write.")] = Path(
        "compare.html"
    ),
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Put runs side by side on one page. The page shows their figures, parameters and times, and
    surfaces that turn together.

    Example: vorolight compare bunny.vorolight finer.vorolight
    """
    from vorolight.stages.report import comparison

    if len(runs) < 2:
        raise UsageError(
            f"{runs[0]}: there is nothing to compare with; give two or more run folders"
        )
    if len({path.resolve() for path in runs}) < len(runs):
        raise UsageError("a run folder is given twice; give different run folders")
    for path in runs:
        if not path.is_dir():
            raise ArtifactError(f"{path}: no such run folder; check the path")
    if output.is_dir() or not output.parent.is_dir():
        raise UsageError(f"{output}: cannot be written there; give another file with -o")
    folders = [RunFolder(path) for path in runs]
    found = comparison.opened(folders, [outdated(folder) for folder in folders])
    differs = comparison.difference(found)
    if differs:
        print(f"warning: {differs}", file=sys.stderr)
    comparison.write(found, output)
    if not quiet:
        print(f"comparison: {output}")
