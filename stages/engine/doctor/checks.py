"""Check that everything vorolight needs is installed and works, with advice where it does not.

The checks run in a child process, since a library may crash its process or never return.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

from . import installation, machine
from .finding import Finding

SECONDS = 120
"""Seconds after which a running check is abandoned."""


Check = Callable[[Path], Iterable[Finding]]
"""A check; its argument is the folder in which runs will be written."""


def checks() -> dict[str, Check]:
    """All checks by name, in the order in which they are reported."""
    return {
        "python": installation.python,
        "libraries": installation.libraries,
        "extras": installation.extras,
        "Delaunay": installation.delaunay,
        "compiled loops": installation.kernels,
        "torch operations": installation.torch_operations,
        "distances": installation.distances,
        "solids": installation.solids,
        "3MF": installation.threemf,
        "HDF5": installation.hdf5,
        "mesh repair": installation.repair,
        "threads": machine.threads,
        "memory": machine.memory_there,
        "GPU": machine.gpu,
        "disk": machine.disk,
        "files": machine.files,
        "programs": machine.programs,
    }


def examine(folder: Path, names: Iterable[str] | None = None) -> Iterator[Finding]:
    """The findings of the checks called ``names``, by default of all checks, as they come.

    A check that fails, crashes or does not end is a finding of kind problem; the others continue.
    """
    left = list(checks() if names is None else names)
    while left:
        yield from _by_child(folder, left)


def _by_child(folder: Path, left: list[str]) -> Iterator[Finding]:
    """Run the checks in ``left`` in a child process, and remove each from ``left`` when it has
    ended, also the one that ended the child."""
    child = subprocess.Popen(
        # -P: modules in the user's current folder must not replace those of vorolight.
        [sys.executable, "-P", "-m", __name__, str(folder), *left],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        encoding="utf-8",
    )
    timer = threading.Timer(SECONDS, child.kill)
    timer.start()
    try:
        assert child.stdout is not None
        for line in child.stdout:
            told = json.loads(line)
            if told is None:
                left.pop(0)
            else:
                yield Finding(**told)
        code = child.wait()
    finally:
        late = not timer.is_alive()
        timer.cancel()
        child.kill()
        child.wait()
    if left:
        how = f"did not end within {SECONDS} s" if late else f"crashed with exit code {code}"
        advice = "reinstall vorolight and its libraries: pip install --force-reinstall vorolight"
        yield Finding(left.pop(0), how, "problem", advice)


def _tell(folder: str, *names: str) -> None:
    """Run checks and print each finding as a line of JSON, and null after every check."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries may print too
    known = checks()
    for name in names:
        try:
            for finding in known[name](Path(folder)):
                print(json.dumps(asdict(finding)), file=out, flush=True)
        # A check may raise anything, since finding faults is its purpose.
        except BaseException as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            advice = "repair or reinstall the library that is named there"
            print(json.dumps(asdict(Finding(name, reason, "problem", advice))), file=out)
        print("null", file=out, flush=True)


if __name__ == "__main__":
    _tell(*sys.argv[1:])
