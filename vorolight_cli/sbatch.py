"""``vorolight sbatch``: many shapes on a Slurm cluster, one array of jobs a stage."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import registry
from vorolight.stages.errors import BackendMissing, UsageError

from . import completion
from .parameters import build, parameter_names, read_config
from .session import Quiet, Verbose

ListFile = Annotated[
    Path,
    typer.Argument(metavar="SHAPES", help="A text file with one INPUT a line; # for comments."),
]
Text = str | None


def sbatch(
    shapes: ListFile,
    submit: Annotated[
        bool,
        typer.Option(
            "--submit",
            help="Submit the jobs and print their numbers, in place of printing the script.",
        ),
    ] = False,
    until: Annotated[
        str,
        typer.Option(
            help="The last stage to run.", autocompletion=completion.choices(completion.stages)
        ),
    ] = "fabricate",
    n: Annotated[
        int | None, typer.Option("-n", help="Voxels along the longest side.", min=2, max=100_000)
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file with a table of options per stage.")
    ] = None,
    runs: Annotated[
        Path, typer.Option("--runs", help="The folder that holds the run folders.")
    ] = Path(),
    threads: Annotated[
        int, typer.Option(help="Threads and processors of a job.", min=1, max=1024)
    ] = 1,
    memory: Annotated[Text, typer.Option(help="Memory of a job, such as 3G.")] = None,
    time: Annotated[Text, typer.Option(help="Time limit of a job, such as 2:00:00.")] = None,
    partition: Annotated[Text, typer.Option(help="The partition to run in.")] = None,
    account: Annotated[Text, typer.Option(help="The account to charge.")] = None,
    at_once: Annotated[
        int | None, typer.Option(help="Jobs of an array that may run at once.", min=1)
    ] = None,
    array_size: Annotated[
        int, typer.Option(help="Shapes in an array; must be less than Slurm's MaxArraySize.", min=1)
    ] = 1000,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Print or submit Slurm jobs that run every shape of a list. A job that reaches its time limit,
    or gets SIGUSR1, stops at a checkpoint and is queued again.

    Example: vorolight sbatch shapes.txt -n 25 --time 1:00:00 --submit
    """
    from vorolight.stages.artifacts import atomic
    from vorolight.stages.inputs import shape_list

    from .slurm_script import Plan, script

    if until not in registry.ORDER:
        raise UsageError(f"--until {until}: must be one of {', '.join(registry.ORDER)}")
    stages = registry.ORDER[: registry.ORDER.index(until) + 1]
    given = read_config(config, registry.ALL)
    for stage in map(registry.get, stages):  # refused here, not by every job
        build(stage, {}, given, parameter_names([stage])[stage.name])
    listed = shape_list.read(shapes)
    views = [i for i, shape in enumerate(listed, 1) if shape.kind == "views"]
    asked = {"mem": memory, "time": time, "partition": partition, "account": account}
    plan = Plan(
        name=shapes.stem,
        folder=Path.cwd(),
        python=sys.executable,
        inputs=tuple(shape.input for shape in listed),
        runs=tuple(str(RunFolder.locate(None, s.stem, runs).path) for s in listed),
        # No stage reads the results of shade, so the shapes that have views run it last.
        stages=tuple(stage for stage in stages if stage != "shade"),
        last=("shade", tuple(views)) if views and "shade" in stages else None,
        resolution=n,
        config=None if config is None else config.read_text(encoding="utf-8"),
        threads=threads,
        asked={key: value for key, value in asked.items() if value is not None},
        at_once=at_once,
        array_size=array_size,
    )
    text, logs = script(plan)
    if not submit:
        print(text, end="")
        return
    if shutil.which("sbatch") is None:
        raise BackendMissing(
            "sbatch is not installed here; run this command on a machine with Slurm, or leave out "
            "--submit and run the printed script there"
        )
    kept = Path(logs) / "submit.sh"
    atomic.make_folder(kept.parent)
    atomic.write(kept, text.encode())
    done = subprocess.run(["bash", str(kept)], stdout=subprocess.PIPE, text=True)
    if not quiet:
        print(done.stdout, end="")
    if done.returncode:
        raise UsageError(
            f"{shapes}: Slurm did not take all jobs, for the reason above; correct the options, or "
            "continue with the command that the script printed"
        )
