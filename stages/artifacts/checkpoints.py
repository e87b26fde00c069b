"""Checkpoints of a training: files with a fingerprint, of which the last two are kept."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import ArtifactError
from . import atomic, hdf5, requeue

KEPT = 2
COST = 50.0
"""Smallest time between two checkpoints, divided by the time that writing one takes, so that 2
% of the time is lost."""


class Checkpoints:
    """The checkpoints of one run of a stage. Those of other parameters or inputs are ignored."""

    def __init__(
        self,
        folder: Path,
        fingerprint: str,
        tell: Callable[..., None] = lambda event, **facts: None,
    ) -> None:
        self.folder = folder / fingerprint[:16]
        self.fingerprint = fingerprint
        self.tell = tell
        self._cost, self._written = 0.0, time.monotonic()

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.h5"))

    def save(self, iteration: int, state: Callable[[], Mapping[str, Any]]) -> None:
        """Write ``state()`` after ``iteration`` iterations and remove the oldest files, unless the
        last checkpoint is too recent.

        Raises Stopped afterwards if the process was asked to stop.
        """
        begun = time.monotonic()
        if begun - self._written < COST * self._cost and not requeue.asked():
            return
        arrays = {name: hdf5.as_array(value) for name, value in state().items()}
        facts = {"fingerprint": self.fingerprint, "iteration": iteration}
        data = hdf5.encode(None, arrays, facts | {"sha256": _digest(iteration, arrays)})
        atomic.make_folder(self.folder)
        atomic.write(self.folder / f"{iteration:06d}.h5", data)
        for old in self._files()[:-KEPT]:
            atomic.discard(old)
        self._written = time.monotonic()
        self._cost = self._written - begun
        self.tell("checkpoint", iteration=iteration, bytes=len(data), seconds=round(self._cost, 4))
        requeue.stop_if_asked()

    def latest(self) -> tuple[int, hdf5.Arrays] | None:
        """The newest readable state of this fingerprint, or None."""
        for path in reversed(self._files()):
            try:
                arrays, attributes = hdf5.read(path, None)
            except ArtifactError as error:
                self.tell("checkpoint ignored", reason=str(error))
                continue
            iteration: Any = attributes.get("iteration")
            if attributes.get("fingerprint") != self.fingerprint:
                continue
            if attributes.get("sha256") != _digest(iteration, arrays):
                self.tell("checkpoint ignored", reason=f"{path}: damaged")
                continue
            self.tell("resumed", iteration=int(iteration))
            return int(iteration), arrays
        return None

    def clear(self) -> None:
        """Remove all checkpoints of the stage, including those of other parameters, after
        its result is written."""
        shutil.rmtree(self.folder.parent, ignore_errors=True)
        with contextlib.suppress(OSError):  # the folder may have checkpoints of other stages
            self.folder.parent.parent.rmdir()


def _digest(iteration: Any, arrays: hdf5.Arrays) -> str:
    """A checksum that tells an intact checkpoint from a damaged one."""
    found = hashlib.sha256(str(iteration).encode())
    for name in sorted(arrays):
        array = arrays[name]
        found.update(f"{name}{array.dtype.str}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()
