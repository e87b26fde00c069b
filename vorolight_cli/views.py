"""``vorolight views``: a set of views rendered from a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.errors import UsageError

from .console import Console
from .session import Quiet, Threads, Verbose


def views(
    mesh: Annotated[Path, typer.Argument(help="A mesh, with a texture or colours or without.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The folder to write to.")],
    count: Annotated[
        int, typer.Option(min=2, max=100_000, help="Views; 6 are those along the axes.")
    ] = 300,
    size: Annotated[int, typer.Option(min=16, max=8192, help="Pixels along a side.")] = 512,
    texture: Annotated[
        Path | None,
        typer.Option(help="A picture in place of the mesh's own texture.", show_default=False),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="perspective or orthographic. Default: orthographic for 6 views.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the random sides.")] = 0,
    threads: Threads = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a set that is there.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Render a mesh to a set of views: pictures with alpha, normal maps, transforms.json.

    Example: vorolight views cow.obj -o cow-views --count 300
    """
    from vorolight.stages import standing
    from vorolight.stages.sources.view_writer import write_views

    if camera not in (None, "perspective", "orthographic"):
        raise UsageError(f"--camera {camera}: must be perspective or orthographic")
    console = Console(0 if quiet else 1, False, False)
    console.start("views", count)
    try:
        written = write_views(
            mesh, output, count, size, camera, seed, force,  # type: ignore[arg-type]
            threads or standing.available_threads(), console.advance, texture,
        )  # fmt: skip
    finally:
        console.finish()
    print(written)
