"""Reading of scans by libraries that may end the process at damaged files: only the child process
that this module becomes calls them."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ..errors import BackendMissing
from . import packed
from .text_table import Table

SECONDS = 300


def read(path: Path, module: str, libraries: tuple[str, ...]) -> Table:
    """The points that ``points`` of the sibling ``module`` finds in the file at ``path``, and what
    it says of them.

    Raises BackendMissing where one of ``libraries`` is not installed, ValueError for files that
    cannot be read.
    """
    for library in libraries:
        if importlib.util.find_spec(library) is None:
            raise BackendMissing(
                f"{path}: {packed.ending(path)[1:].upper()} files are read by {library}, which is "
                "not installed: pip install 'vorolight[scans]'"
            )
    with tempfile.TemporaryDirectory() as folder:
        given, found = path, Path(folder) / "found.npz"
        if packed.is_packed(path):
            given = Path(folder) / f"given{packed.ending(path)}"
            given.write_bytes(packed.content(path))
        try:
            done = subprocess.run(
                [sys.executable, "-m", __name__, module, str(given.resolve()), str(found)],
                capture_output=True, text=True, errors="replace", timeout=SECONDS,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise ValueError(f"it took longer than {SECONDS} s; thin the points") from None
        if done.returncode == 1:
            raise ValueError((done.stderr.strip().splitlines() or ["it is damaged"])[-1])
        if done.returncode or not found.is_file():
            raise ValueError(f"{libraries[-1]} ended with {done.returncode}; it is damaged")
        with np.load(found) as arrays:
            return Table(arrays["points"], None, str(arrays["note"]))


def _find(module: str, given: str, found: str) -> None:
    try:
        points, note = importlib.import_module(f".{module}", __package__).points(Path(given))
    # The libraries raise whatever damaged bytes lead them to, lazrs what is no Exception, and
    # pye57 hides the error behind others.
    except BaseException as error:
        while error.__context__ is not None:
            error = error.__context__
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        raise SystemExit(1) from None
    np.savez(found, points=points, note=np.array(note))


if __name__ == "__main__":
    _find(*sys.argv[1:])
