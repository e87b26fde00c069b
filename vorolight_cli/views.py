"""``vorolight views`` and ``from-image``: sets of views, of a mesh or of one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.errors import BackendMissing, InputError, UsageError

from . import completion
from .console import Console
from .session import AllowCode, Quiet, Threads, Verbose


def views(
    mesh: Annotated[
        Path, typer.Argument(help="A mesh; a texture or colours are used if it has them.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The folder to write.")],
    count: Annotated[
        int, typer.Option(min=2, max=100_000, help="Number of views; 6 views look along the axes.")
    ] = 300,
    size: Annotated[int, typer.Option(min=16, max=8192, help="Pixels along a side.")] = 512,
    texture: Annotated[
        Path | None,
        typer.Option(
            help="A picture to use in place of the mesh's own texture.", show_default=False
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="Camera [perspective|orthographic]. Default: orthographic for 6 views, else "
            "perspective.",
            autocompletion=completion.choices(lambda: ("perspective", "orthographic")),
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random directions.")] = 0,
    threads: Threads = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an existing set of views.")
    ] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Render a mesh from many directions, as a set of views. Writes pictures with alpha channels,
    normal maps and transforms.json.

    Example: vorolight views cow.obj -o cow-views --count 300
    """
    from vorolight.stages.engine.session import available_threads
    from vorolight.stages.inputs.views.writer import write_views

    if camera not in (None, "perspective", "orthographic"):
        raise UsageError(f"--camera {camera}: must be perspective or orthographic")
    console = Console(0 if quiet else 1, False, False)
    console.start("views", count)
    try:
        written = write_views(
            mesh, output, count, size, camera, seed, force,  # type: ignore[arg-type]
            threads or available_threads(), console.advance, texture,
        )  # fmt: skip
    finally:
        console.finish()
    print(written)


def from_image(
    photo: Annotated[Path, typer.Argument(help="A picture of the object.")],
    six_views: Annotated[
        Path | None,
        typer.Option(
            help="A folder with six views of the object that another program made: front.png, "
            "right.png, back.png, left.png, top.png and bottom.png, or six numbered pictures. "
            "Normal maps, such as front_normal.png, are optional.",
            show_default=False,
        ),
    ] = None,
    generator: Annotated[
        str | None,
        typer.Option(
            help="MODULE:FUNCTION that takes the picture and makes such a folder.",
            show_default=False,
        ),
    ] = None,
    allow_code: AllowCode = False,
    order: Annotated[
        str | None,
        typer.Option(
            help="Which views numbered pictures are. Default: front,right,back,left,top,bottom.",
            show_default=False,
        ),
    ] = None,
    background: Annotated[
        str,
        typer.Option(
            help="Of opaque pictures without masks: the colour that is taken out from their edges "
            "on: auto, white, black, or red, green and blue as in 0,177,64."
        ),
    ] = "auto",
    enclosed: Annotated[
        str,
        typer.Option(
            help="Areas of the background's colour within the object are parts of it, or "
            "background. [object|background]",
            autocompletion=completion.choices(lambda: ("object", "background")),
        ),
    ] = "object",
    invert_masks: Annotated[
        bool, typer.Option("--invert-masks", help="Masks or alpha have the object dark.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="The folder to write. Default: PHOTO-views."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an existing set of views.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """Make a set of views from six views of one picture. vorolight has no generator of
    views: give six views that another program made, or a function that calls such a program.

    Example: vorolight from-image cow.jpg --six-views cow-made && vorolight run cow-views -n 40
    """
    from vorolight.stages.inputs.views import six_views as six
    from vorolight.stages.inputs.views.silhouettes import Reading, parse_background

    if not photo.is_file():
        raise InputError(f"{photo}: no such file; give the path of a picture")
    if six_views is not None and generator is not None:
        raise UsageError("--generator and --six-views: both are given; give one of them")
    if enclosed not in ("object", "background"):
        raise UsageError(f"--enclosed {enclosed}: must be object or background")
    reading = Reading(parse_background(background), enclosed == "background", invert_masks)
    views_of = None if order is None else six.parse_order(order)
    if six_views is not None:
        made = six.of_folder(six_views, views_of, reading)
    elif generator is not None:
        made = six.of_generator(generator, photo, allow_code, views_of, reading)
    else:
        raise BackendMissing(
            "there is no built-in generator of six views: make the views with another program, "
            "such as Hunyuan3D-2, and give their folder with --six-views, or give a function that "
            "calls such a program with --generator MODULE:FUNCTION"
        )
    for note in made.notes:
        Console(1, False, False).warn(note)
    target = six.write(made, output or photo.with_name(f"{photo.stem}-views"), force)
    print(f"{target}\nnow: vorolight run {target.parent} -n 40")
