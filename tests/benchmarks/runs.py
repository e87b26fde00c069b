"""Runs from which the tables are read, and figures as Markdown."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import paper

NOT_RUN = "not run"


@dataclass(frozen=True)
class Settings:
    """Where and on which meshes the tables are made."""

    work: Path
    pictures: Path
    meshes: list[Path]
    n: int = 25
    samples: int | None = None
    points: int = 153_600
    epochs: int | None = None
    noise: tuple[float, ...] = paper.NOISE
    noise_n: int = 15
    noise_shapes: int = 2
    shape_weights: tuple[float, ...] = (10.0, 100.0)
    normal_weights: tuple[float, ...] = (0.0, 10.0)
    resolutions: tuple[int, ...] = paper.RESOLUTIONS
    inner: tuple[int, ...] = paper.INNER
    views: tuple[int, ...] = (300, 6)
    view_n: int = 40
    view_size: int = 512
    view_shapes: int = 3
    panel: int = 300
    flags: tuple[str, ...] = ()
    """Options of every sphere-train."""


def quick(given: Settings) -> Settings:
    """The same settings for a few small runs on the first of the meshes."""
    return replace(
        given,
        meshes=given.meshes[:2],
        n=6,
        samples=2000,
        points=5000,
        epochs=20,
        noise=(0.0, 1.0),
        noise_n=6,
        noise_shapes=1,
        shape_weights=(100.0,),
        normal_weights=(0.0, 1.0),
        resolutions=(5, 6),
        inner=(20, 40),
        views=(12, 6),
        view_n=6,
        view_size=96,
        view_shapes=1,
        panel=120,
        flags=("--iterations", "3"),
    )


class Failed(RuntimeError):
    """A run that failed, with its message."""


def cli(*words: object) -> None:
    """Run the tool. Raises Failed."""
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if not line.startswith("warning")]
        raise Failed(f"{words[0]}: {said[-1] if said else done.returncode}")


def attempt(what: str, action: Callable[[], Any]) -> Any:
    """The result of ``action``, or the message with which it failed."""
    print(what, flush=True)
    try:
        return action()
    except Failed as fault:
        print(f"  {fault}", flush=True)
        return str(fault)


def metrics(run: Path, stem: str) -> dict[str, Any]:
    return json.loads((run / f"{stem}.json").read_text())["metrics"]


def cpu_seconds(run: Path, stem: str) -> float:
    return json.loads((run / f"{stem}.json").read_text())["volatile"]["cpu_seconds"]


def evaluated(given: Settings, run: Path, of: str, reference: Path | None = None) -> dict[str, Any]:
    """The metrics of the evaluation of a stage."""
    words: list[object] = ["--samples", given.samples] if given.samples else []
    words += ["--reference", reference] if reference else []
    cli("evaluate", "--of", of, *words, "--run", run)
    return metrics(run, f"evaluate-{of}")


def started(given: Settings, source: object, name: str, n: int) -> Path:
    """The run folder ``name`` with the first two stages done."""
    run = given.work / f"{name}.vorolight"
    cli("init", source, "-n", n, "--run", run)
    return run


def branch(given: Settings, run: Path, name: str, source: object, n: int) -> Path:
    """A run folder that continues from the first two stages of ``run``."""
    other = given.work / f"{name}.vorolight"
    if not other.exists():
        staging = other.with_suffix(".copying")
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        for path in [*run.glob("classify.*"), *run.glob("init.*")]:
            shutil.copy2(path, staging / path.name)
        staging.rename(other)
    cli("init", source, "-n", n, "--run", other)
    return other


def trained(given: Settings, source: object, name: str, n: int, way: str, *words: object) -> Path:
    """A run folder for each way of training, all from the same first surface."""
    first = started(given, source, f"{name}-{n}", n)
    run = branch(given, first, f"{name}-{n}-{way}", source, n)
    cli("sphere-train", *words, *given.flags, "--run", run)
    return run


TRIANGLE = ("--faces", "triangle")
POLYGON = ("--faces", "polygon")


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table as Markdown."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def number(value: float | None, form: str = ".4g") -> str:
    return "-" if value is None else format(value, form)


def spread(values: list[float], form: str = ".4g") -> str:
    return f"{np.mean(values):{form}} ± {np.std(values):{form}}"
