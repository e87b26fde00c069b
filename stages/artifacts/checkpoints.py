"""Training checkpoints: whole files, the last two kept, found again by fingerprint."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import ArtifactError
from . import atomic, hdf5

KEPT = 2


class Checkpoints:
    """The checkpoints of one stage run; those of other parameters or inputs are ignored."""

    def __init__(self, folder: Path, fingerprint: str) -> None:
        self.folder = folder / fingerprint[:16]
        self.fingerprint = fingerprint

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.h5"))

    def save(self, iteration: int, arrays: Mapping[str, Any]) -> None:
        """Write the state after ``iteration`` iterations and drop the oldest files."""
        atomic.make_folder(self.folder)
        data = hdf5.encode(None, arrays, {"fingerprint": self.fingerprint, "iteration": iteration})
        atomic.write(self.folder / f"{iteration:06d}.h5", data)
        for old in self._files()[:-KEPT]:
            old.unlink(missing_ok=True)

    def latest(self) -> tuple[int, hdf5.Arrays] | None:
        """The newest readable state of this fingerprint, or None."""
        for path in reversed(self._files()):
            try:
                arrays, attributes = hdf5.decode(path, None)
            except ArtifactError:
                continue
            if attributes.get("fingerprint") == self.fingerprint:
                return int(attributes["iteration"]), arrays
        return None

    def clear(self) -> None:
        """Remove all of the stage, of other parameters too, once its result is written."""
        shutil.rmtree(self.folder.parent, ignore_errors=True)
        with contextlib.suppress(OSError):  # other stages may have checkpoints there
            self.folder.parent.parent.rmdir()
