"""``vorolight doctor``: check the installation and the machine."""

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
            help="The folder in which runs will be written. Default: the current folder.",
            show_default=False,
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per check.")] = False,
    verbose: Verbose = False,
) -> None:
    """Check the installation and the machine. It looks at libraries and their versions, processors,
    memory, the disk of the run folders, and optional programs. The exit code is 0 without problems
    and 69 with a problem. It leaves no files behind.

    Example: vorolight doctor --run /scratch/runs
    """
    from vorolight.stages.engine.doctor.checks import examine

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
        raise BackendMissing(f"{many} found ({', '.join(problems)}); follow the advice above")
