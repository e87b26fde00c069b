"""Reads scans in a child process, because the libraries may end the process on damaged files.

This module is both the parent's function and the program of the child.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import tempfile
from pathlib import Path

import numpy as np

from ..child import Arrays, ChildFailed, answer, in_child
from ..errors import BackendMissing
from . import packed
from .text_table import Table

SECONDS = 300
"""The time after which the child process is stopped."""


def read(path: Path, module: str, libraries: tuple[str, ...]) -> Table:
    """The points that the function ``points`` of ``module`` reads from ``path``, and its note.

    Raises BackendMissing if one of ``libraries`` is not installed, and ValueError if the file
    cannot be read.
    """
    for library in libraries:
        if importlib.util.find_spec(library) is None:
            raise BackendMissing(
                f"{path}: {packed.ending(path)[1:].upper()} files are read by {library}, which is "
                "not installed: pip install 'vorolight[scans]'"
            )
    with tempfile.TemporaryDirectory() as folder:
        given = path
        if packed.is_packed(path):
            given = Path(folder) / f"given{packed.ending(path)}"
            given.write_bytes(packed.content(path))
        try:
            words = {"module": np.array(module), "path": np.array(str(given.resolve()))}
            found = in_child(__name__, words, SECONDS)
        except ChildFailed as error:
            raise ValueError(f"{error} (read by {' and '.join(libraries)})") from None
    return Table(found["points"].astype(float), None, str(found["note"]))


def _points(given: Arrays) -> Arrays:
    reader = importlib.import_module(f".{given['module']}", __package__)
    try:
        points, note = reader.points(Path(str(given["path"])))
    # On damaged files the libraries raise exceptions of any kind: those of lazrs do not derive from
    # Exception, and pye57 hides the first error behind others.
    except BaseException as error:
        while error.__context__ is not None:
            error = error.__context__
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        raise SystemExit(1) from None
    return {"points": points, "note": np.array(note)}


if __name__ == "__main__":
    answer(_points)
