"""``vorolight doctor``: whether everything is here and works."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.errors import BackendMissing

from .console import Console
from .session import Verbose


def doctor(
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            envvar="VOROLIGHT_RUN",
            help="Where runs are to be written. Default: the current folder.",
            show_default=False,
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON object per check.")] = False,
    verbose: Verbose = False,
) -> None:
    """Say whether everything that vorolight needs is here and works: libraries and their versions,
    processors, memory, the disk that runs are written to, programs beside it. Ends with 0 unless
    something is a problem, with 69 if so. Nothing is left behind.

    Example: vorolight doctor --run /scratch/runs
    """
    from vorolight.stages.doctor import examine

    console = Console(1, json, False)
    problems = []
    for finding in examine(Path() if run is None else run):
        console.data(asdict(finding))
        console.say(f"{finding.verdict:8s} {finding.name:18s} {finding.found}")
        if finding.advice is not None:
            console.say(f"{'':27s} -> {finding.advice}")
        if finding.verdict == "problem":
            problems.append(finding.name)
    if problems:
        many = "a problem" if len(problems) == 1 else f"{len(problems)} problems"
        raise BackendMissing(f"{many} found ({', '.join(problems)}); do what is said there")
