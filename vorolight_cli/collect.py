"""``vorolight collect``: many runs as one table."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.errors import UsageError

from .console import Console
from .session import Quiet, Verbose


def collect(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Run folders, or folders that contain run folders (*.vorolight)."),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="The .csv or .parquet file to write; - prints CSV."),
    ] = Path("-"),
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--columns",
            metavar="PATTERN",
            help="Keep only the columns that match, such as 'evaluate-*.chamfer.*'; run and error "
            "always stay. May be given several times.",
            show_default=False,
        ),
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write one table of many runs. A run is a row: its input, its options, the state of each
    stage, times, memory, and every figure of its manifests as stage.figure.

    Example: vorolight collect runs/ -o runs.csv --columns 'evaluate-*'
    """
    from vorolight.stages.artifacts import atomic
    from vorolight.stages.engine import collection

    printed = str(output) == "-"
    if not printed:
        if output.suffix not in (".csv", ".parquet"):
            raise UsageError(f"{output}: must end with .csv or .parquet, or be - to print CSV")
        if output.is_dir() or not output.parent.is_dir():
            raise UsageError(f"{output}: cannot be written there; give another file with -o")
        if output.suffix == ".parquet":
            collection.require_parquet()
    console = Console(0 if quiet else 1, False, False)
    folders = collection.run_folders(runs)

    def report(number: int, row: dict[str, collection.Value]) -> None:
        if row["error"] is not None:
            console.warn(f"{row['run']}: {row['error']}")
        if len(folders) >= MANY:
            console.advance(number)

    console.start("collect", len(folders))
    try:
        found = collection.gather(folders, report)
    finally:
        console.finish()
    found = collection.selected(found, columns or [])
    if printed:
        sys.stdout.buffer.write(collection.as_csv(found))
        return
    made = collection.as_csv if output.suffix == ".csv" else collection.as_parquet
    atomic.write(output, made(found))
    console.say(f"{output}: {len(folders)} runs, {len(found)} columns")


MANY = 200
"""From this many runs on, progress is shown."""
