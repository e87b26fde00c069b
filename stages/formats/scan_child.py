"""Reading of scans by libraries that may end the process at damaged files: only the child process
that this module becomes calls them."""

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
    # The libraries raise whatever damaged bytes lead them to, lazrs what is no Exception, and
    # pye57 hides the error behind others.
    except BaseException as error:
        while error.__context__ is not None:
            error = error.__context__
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        raise SystemExit(1) from None
    return {"points": points, "note": np.array(note)}


if __name__ == "__main__":
    answer(_points)
