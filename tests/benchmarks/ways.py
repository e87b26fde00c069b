"""The ways to run a list of shapes. All must end with the same bytes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
STAGES = ("classify", "init", "sphere-train", "volume", "evaluate", "fabricate")
OPTIONS = """\
[classify]
n-init = 6
[init]
iterations = 5
[sphere-train]
iterations = 20
faces = "polygon"
[volume]
inner = 20
cvt-iterations = 5
[evaluate]
samples = 2000
[fabricate]
lamp = false
sides = 6
"""
# The same options as the Makefile's variables.
MAKE = ["N=6", "FACES=polygon", "INNER=20", "FABRICATE=--no-lamp", "THREADS=1"]


class Failed(RuntimeError):
    """A way that failed, with its message."""


def prepare(folder: Path, count: int = 8) -> Path:
    """A folder with ``count`` small shapes, their list, and options.

    Two are fields, the others boxes and ellipsoids.
    """
    import trimesh

    folder.mkdir(parents=True)
    names = ["sphere", "heart"][:count]
    for k in range(count - len(names)):
        size = [1.0, 1.0 + 0.1 * k, 1.5]
        mesh = trimesh.creation.box(size) if k % 2 else trimesh.creation.icosphere(2)
        if k % 2 == 0:
            mesh.apply_scale(size)
        names.append(f"shape{k}.ply")
        mesh.export(folder / names[-1])
    (folder / "shapes.txt").write_text("# INPUTs\n" + "".join(f"{name}\n" for name in names))
    (folder / "options.toml").write_text(OPTIONS)
    return folder


def shapes(folder: Path) -> list[str]:
    return (folder / "shapes.txt").read_text().splitlines()[1:]


def call(*words: object, cwd: Path, **variables: str) -> str:
    """The output of a command that finds this environment's tools. Raises Failed."""
    path = os.pathsep.join([str(BIN), os.environ.get("PATH", "")])
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env={**os.environ, "PATH": path, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        raise Failed(f"{' '.join(map(str, words))[:200]}: {done.returncode}\n{done.stdout[-3000:]}")
    return done.stdout


def directly(folder: Path, stages: Sequence[str] = STAGES) -> None:
    """One command after the other."""
    for shape in shapes(folder):
        run = f"runs/{Path(shape).stem}.vorolight"
        for stage in stages:
            words = ["--", shape] if stage == "classify" else []
            options = ["--run", run, "--threads", 1, "--config", "options.toml"]
            call(sys.executable, "-m", "vorolight.cli", stage, *options, *words, cwd=folder)


def by_make(folder: Path) -> None:
    """With make, two at a time. The Makefile sets some options itself, and
    evaluates the first surface."""
    names = [str(folder / s) if (folder / s).exists() else s for s in shapes(folder)]
    places = [f"RUNS={folder}/runs", f"CONFIG={folder}/options.toml", f"VENV={BIN.parent}"]
    call("make", "-j2", "shapes", f"SHAPES={' '.join(names)}", *MAKE, *places, cwd=ROOT)


def by_snakemake(folder: Path, *words: object, profile: str = "local") -> str:
    """With examples/cluster, on the processors of this machine or with another profile."""
    here = ROOT / "examples" / "cluster"
    shutil.copy(here / "config.yaml", folder)
    command = [sys.executable, "-m", "snakemake", "-s", here / "Snakefile"]
    return call(*command, "--profile", here / "profiles" / profile, *words, cwd=folder)


def by_snakemake_on_slurm(folder: Path) -> None:
    """With examples/cluster on Slurm, without accounting and with frequent queries."""
    words = ["--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", 5]
    by_snakemake(folder, *words, "--default-resources", "mem_mb=1000", profile="slurm")


def by_sbatch(folder: Path) -> None:
    """With ``vorolight sbatch --submit``, until the queue is empty."""
    words = ["sbatch", "shapes.txt", "--runs", "runs", "--config", "options.toml", "--submit"]
    call(sys.executable, "-m", "vorolight.cli", *words, cwd=folder)
    wait_for_queue(900)


def slurm_answers() -> bool:
    """Whether Slurm is installed and runs."""
    return (
        shutil.which("sinfo") is not None
        and subprocess.run(["sinfo"], capture_output=True, timeout=60).returncode == 0
    )


def wait_for_queue(seconds: float) -> None:
    """Wait until Slurm has no jobs of this user. Raises Failed if that takes
    longer than ``seconds``."""
    deadline = time.monotonic() + seconds
    while left := call("squeue", "--me", "--noheader", cwd=ROOT):
        if time.monotonic() > deadline:
            raise Failed(f"still in the queue:\n{left}")
        time.sleep(1)


WAYS: dict[str, Callable[[Path], object]] = {
    "one after the other": directly,
    "make -j2 shapes": by_make,
    "snakemake, 2 cores": by_snakemake,
    "vorolight sbatch": by_sbatch,
    "snakemake on Slurm": by_snakemake_on_slurm,
}


def runs(folder: Path) -> list[Path]:
    return sorted((folder / "runs").glob("*.vorolight"))


def results(run: Path) -> dict[str, object]:
    """All results that must not depend on the way.

    These are the files of a run, without logs, the report, and the evaluation of the first surface,
    which only make asks for; and the manifests without their volatile blocks.
    """
    found: dict[str, object] = {}
    for path in sorted(run.rglob("*")):
        name = path.relative_to(run).as_posix()
        if not path.is_file() or name.startswith(("logs/", "report.html", "evaluate-init.")):
            continue
        found[name] = path.read_bytes()
        if path.suffix == ".json":
            record = json.loads(path.read_text())
            found[name] = {key: value for key, value in record.items() if key != "volatile"}
    return found


def differences(folder: Path, other: Path) -> list[str]:
    """The files of the runs in both folders that are not the same."""
    names = {run.name for place in (folder, other) for run in runs(place)}
    faults = [] if names else [f"{folder}: no run"]
    for run in sorted(names):
        one, two = results(folder / "runs" / run), results(other / "runs" / run)
        faults += [f"{run}/{n}" for n in sorted(one | two) if one.get(n) != two.get(n)]
    return faults


def copied(folder: Path, target: Path) -> Path:
    """A copy of the shapes and options of ``folder``, without results."""
    made = shutil.ignore_patterns("runs", ".snakemake", "slurm-logs", "table.csv")
    shutil.copytree(folder, target, ignore=made)
    return target
