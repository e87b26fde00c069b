"""The ``vorolight`` command."""

from __future__ import annotations

import functools
import inspect
import os
import sys
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import freshness, registry, runner
from vorolight.stages.engine.stage import Stage
from vorolight.stages.errors import (
    BackendMissing,
    InputError,
    NumericalFailure,
    UsageError,
    VorolightError,
)

from . import completion, signals, summary
from .collect import collect
from .compare import compare, outdated
from .console import Console, plain
from .doctor import doctor
from .epilog import EPILOG
from .export import export
from .gating import gating
from .panels import Panels
from .parameters import Function, add_options, build, parameter_names
from .sbatch import sbatch
from .session import Common, Quiet, Run, Verbose, common_options
from .status import status
from .views import from_image, views

HELP = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    name="vorolight",
    cls=Panels,
    help="Turn any shape into a smooth, closed Voronoi surface with a certificate, fill it with "
    "Voronoi cells, and make a lamp of it that you can print.",
    epilog=EPILOG,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=HELP,
)

EXAMPLES = {
    "classify": "vorolight classify bunny.obj -n 25",
    "init": "vorolight init bunny.obj -n 25",
    "sphere-train": "vorolight sphere-train --iterations 800",
    "volume": "vorolight volume --inner 800",
    "shade": "vorolight shade --render orbit",
    "evaluate": "vorolight evaluate --of init --reference bunny.obj",
    "fabricate": "vorolight fabricate --lamp --height 120",
    "baseline": "vorolight baseline voromesh bunny.obj -n 25",
}


FIRST = ("init", "baseline")
"""The stages that take an INPUT: they bring classify up to date first."""


def _taken(template: Function, given: dict[str, Any]) -> Any:
    """Call ``template`` with its parameters, which are removed from ``given``."""
    return template(**{name: given.pop(name) for name in inspect.signature(template).parameters})


def _until(
    until: Annotated[
        str,
        typer.Option(
            help="The last stage to run.", autocompletion=completion.choices(completion.stages)
        ),
    ] = "fabricate",
) -> str:
    registry.stages_until(until, "views")  # refuses what is not a stage
    return until


def _preview(
    preview: Annotated[
        bool,
        typer.Option(
            "--preview", help="Draw the voxels and a slice through the shape to classify.png."
        ),
    ] = False,
) -> bool:
    return preview


def _say(error: VorolightError, verbose: bool | None) -> None:
    if verbose:
        traceback.print_exc()
    print(f"vorolight: {plain(str(error))}", file=sys.stderr)


def guarded(function: Function) -> Function:
    """Turn errors into one sentence on stderr and the exit code of their kind."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except VorolightError as error:
            _say(error, kwargs.get("verbose"))
            raise typer.Exit(error.exit_code) from None
        except typer.Exit:
            raise
        except OSError as error:
            if kwargs.get("verbose"):
                traceback.print_exc()
            place = error.filename or "a file"
            text = plain(f"{place}: {error.strerror or error}; remove the cause and run again")
            print(f"vorolight: {text}", file=sys.stderr)
            raise typer.Exit(UsageError.exit_code) from None
        # Any other exception is a fault of vorolight; the user still gets one sentence.
        except Exception as error:
            if kwargs.get("verbose"):
                traceback.print_exc()
            kind = type(error).__name__
            print(
                f"vorolight: internal error ({kind}: {error}); run again with -v and report the "
                "traceback",
                file=sys.stderr,
            )
            raise typer.Exit(1) from None

    return wrapper


def _execute(common: Common, name: str, params: Any) -> bool:
    """Run one stage, or with --dry-run print what would run. True if it ran or would run."""
    console, session = common.console, common.session
    if common.dry_run:
        freshness.check_same_input(session.folder, session.input)
        found = freshness.state(session, name, params)
        reason = "forced" if session.force and found.done else found.reason
        console.say(f"{name}: " + ("up to date" if reason is None else f"would run ({reason})"))
        console.data({"stage": name, "would_run": reason is not None, "reason": reason})
        return reason is not None
    result = runner.execute(session, name, params)
    if result.ran:
        for warning in result.manifest["warnings"]:
            console.warn(f"{name}: {warning}")
        console.say(summary.of(result.manifest, console))
    else:
        console.say(f"{name}: up to date")
    console.data(result.manifest)
    return result.ran


def _stage_command(name: str) -> None:
    stage = registry.get(name)
    served = [registry.get("classify"), stage] if name in FIRST else [stage]
    own: dict[str, list[Function]] = {"evaluate": [gating], "classify": [_preview]}
    templates = [common_options, *own.get(name, [])]

    def command(**given: Any) -> None:
        names = parameter_names(served)
        gates = _taken(gating, given) if name == "evaluate" else None
        preview = name == "classify" and _taken(_preview, given)
        common = _taken(common_options, given)
        params = build(stage, given, common.config, names[name])
        if name in FIRST and _classify_first(name, common, given, names["classify"]):
            return
        _execute(common, name, params)
        if gates and not common.dry_run:
            gates.check(common.session.folder, stage.stem_of(params))
        if preview and not common.dry_run:
            _draw(common)

    command.__doc__ = _help(stage)
    _register(name, command, templates, served)


def _register(name: str, command: Function, templates: list[Function], served: list[Stage]) -> None:
    """Add a command.

    Its options are built only if the command may be the one that is called, or that a shell asks to
    complete: building those of all commands takes as long as the rest of ``--help``.
    """
    completed = (os.environ.get(key, "") for key in ("COMP_WORDS", "_TYPER_COMPLETE_ARGS"))
    if name in [*sys.argv, *" ".join(completed).split()]:
        command = guarded(add_options(command, templates, served))
    else:
        command = add_options(command, [], [])
    app.command(name)(command)


def _help(stage: Stage) -> str:
    """The first paragraph of the stage's module, and an example."""
    module = sys.modules[stage.run.__module__]
    about = (module.__doc__ or "").split("\n\n")[0].partition(": ")[2]
    return f"{about[0].upper()}{about[1:]}\n\nExample: {EXAMPLES[stage.name]}"


def _draw(common: Common) -> None:
    from vorolight.stages.report import preview

    folder = common.session.folder
    source = freshness.input_of(common.session)
    if source is not None:
        opened = source.open(folder.arrays("classify", "classify"))
        common.console.say(f"preview: {preview.write(folder, opened)}")


def _classify_first(
    name: str, common: Common, given: dict[str, Any], names: dict[str, str]
) -> bool:
    """Bring classify up to date; options that are not given stay as recorded.

    True after a dry run in which classify would run, and therefore stage ``name`` too.
    """
    session = common.session
    stage = registry.get("classify")
    stored = session.folder.manifest("classify")
    recorded = stored["params"] if stored else None
    params = build(stage, given, common.config, names, recorded)
    changed = any(given.get(name) is not None for name in names.values()) or common.seed is not None
    seed = stored["seed"] if stored and not changed else session.seed
    unforced = replace(common, session=replace(session, force=False, seed=seed))
    ran = _execute(unforced, "classify", params)
    if common.dry_run and ran:
        common.console.say(f"{name}: would run (classify changed)")
        common.console.data({"stage": name, "would_run": True, "reason": "classify changed"})
        return True
    return False


def _run_command() -> None:
    stages = [registry.get(name) for name in registry.ORDER]

    def command(**given: Any) -> None:
        """Run all stages, from INPUT to the object to print. Writes the report at the end. If a
        shape cannot be printed or filled with cells, the other stages run all the same.

        Example: vorolight run bunny.obj -n 25 --lamp
        """
        names = parameter_names(stages)
        until = _taken(_until, given)
        common = _taken(common_options, given)
        # Without an INPUT the run continues at its recorded resolution.
        stored = None if common.session.input else common.session.folder.manifest("classify")
        recorded = {"classify": stored["params"]} if stored else {}
        planned = {
            stage.name: build(
                stage, given, common.config, names[stage.name], recorded.get(stage.name)
            )
            for stage in stages
        }
        first: str | None = None
        failed: dict[str, int] = {}
        source = freshness.input_of(common.session)
        for name in registry.stages_until(until, "" if source is None else source.kind):
            if first is not None:
                common.console.say(f"{name}: would run ({first} changed)")
                common.console.data(
                    {"stage": name, "would_run": True, "reason": f"{first} changed"}
                )
                continue
            needed = failed.keys() & set(registry.get(name).parents(planned[name]))
            if needed:
                common.console.warn(f"{name}: was not run, because {min(needed)} failed")
                continue
            try:
                ran = _execute(common, name, planned[name])
            except (UsageError, InputError, NumericalFailure, BackendMissing) as error:
                if name not in registry.ENDS:
                    raise
                _say(error, common.console.verbosity > 1)
                failed[name] = error.exit_code
                continue
            if common.dry_run and ran and name not in registry.ENDS:
                first = name
        if not common.dry_run:
            _write_report(common.session.folder, common.console)
        if failed:
            raise typer.Exit(next(iter(failed.values())))

    _register("run", command, [common_options, _until], stages)


def _write_report(folder: RunFolder, console: Console, pictures: Path | None = None) -> None:
    from vorolight.stages.report import page

    console.say(f"report: {page.write(folder, outdated(folder), pictures)}")


@app.command()
@guarded
def report(
    run: Run = None,
    pictures: Annotated[
        Path | None,
        typer.Option("--pictures", help="Write the pictures as PNG files to this folder too."),
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a page with the pictures and figures of a run. It covers the stages that are done.

    Example: vorolight report --run bunny.vorolight
    """
    _write_report(RunFolder.locate(run, None), Console(0 if quiet else 1, False, False), pictures)


@app.command()
@guarded
def sample(
    name: Annotated[
        str,
        typer.Argument(
            help="airplane, bone, bunny, chameleon, cow or cube.",
            autocompletion=completion.choices(completion.samples),
        ),
    ],
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    verbose: Verbose = False,
) -> None:
    """Write a sample mesh or point cloud to the current folder.

    Example: vorolight sample bunny
    """
    from vorolight.stages.artifacts import atomic
    from vorolight.stages.inputs.samples import sample as find

    source = find(name)
    target, data = Path(source.name), source.read_bytes()
    if target.is_dir():
        raise UsageError(f"{target}: is a folder; rename it and run again")
    if target.exists() and target.read_bytes() != data and not force:
        raise UsageError(
            f"{target}: exists with other contents; rename it, or replace it with --force"
        )
    atomic.write(target, data)
    print(target)


app.command()(guarded(status))
app.command()(guarded(compare))
app.command()(guarded(collect))
app.command()(guarded(doctor))
app.command()(guarded(export))
app.command()(guarded(views))
app.command()(guarded(from_image))
app.command()(guarded(sbatch))


def _version(wanted: bool) -> None:
    if wanted:
        print(f"vorolight {runner.tool_version()}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _build() -> None:
    for name in registry.ALL:
        _stage_command(name)
    _run_command()


def main() -> None:
    """Entry point of the console script."""
    # torch's threads would spin between its operations and keep the cores from scipy.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # CUDA's linear algebra gives the same bits every time only with a workspace of its own.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    signals.install()
    _build()
    app()
