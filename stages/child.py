"""Work on arrays by a module that runs as a process of its own: what may crash, take very long, or
is under the GPL."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[np.generic]]
SAID = 200
"""Characters of what a child said that are passed on."""


class ChildFailed(Exception):
    """What went wrong, as part of a sentence."""


def in_child(module: str, given: Arrays, seconds: float) -> dict[str, NDArray[np.generic]]:
    """What ``module``, run as a program that calls ``answer``, makes of the arrays ``given``.

    Raises ChildFailed with what it said if it ends with an error, and where it crashes or takes
    longer than ``seconds``.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(asked, allow_pickle=False, **given)
        try:
            done = subprocess.run(
                [sys.executable, "-m", module, str(asked), str(found)],
                capture_output=True, text=True, errors="replace", timeout=seconds,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise ChildFailed(f"it took longer than {seconds:g} s") from None
        said = done.stderr.strip().splitlines()
        if done.returncode == 1 and said:
            raise ChildFailed(said[-1][:SAID])
        if done.returncode or not found.is_file():
            raise ChildFailed(f"it ended with {done.returncode}")
        with np.load(found) as arrays:
            return dict(arrays)


def answer(work: Callable[[Arrays], Arrays]) -> None:
    """In the child: do ``work`` on the arrays that were given."""
    with np.load(sys.argv[1]) as given:
        np.savez(sys.argv[2], allow_pickle=False, **work(dict(given)))
