"""Faults at every operation that changes the file system: kills, errors, a clock that jumps.

Installed in the process of one trial. Operations are counted by an audit hook; writes, which raise
no audit event, by streams that stand before the real ones.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import random
import re
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

EVENTS = {
    "os.rename", "os.link", "os.symlink", "os.remove", "os.mkdir", "os.rmdir", "os.utime",
    "os.truncate", "os.chmod",
}  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
YEARS = 3e8
"""Seconds that the clock jumps at most, either way."""


@dataclass(frozen=True)
class Fault:
    """What happens at an operation below the folder ``root``."""

    root: str
    log: str
    """A file that gets a line for each operation: what, where."""
    site: str = ""
    """Which operation: as ``alike`` writes it."""
    at: int = 0
    """Its how many-th occurrence, counted from 0."""
    signal: int = 0
    error: str = ""
    """A name of errno: ENOSPC, EACCES ... The operation fails; of a write half is done."""
    half: bool = False
    """The signal comes in the middle of a write, not before it."""
    lasting: bool = False
    """Every later operation fails too, as on a full disk: except removals where it is ENOSPC."""
    clock: int = -1
    """Seed of a clock that jumps at every operation."""


class Injector:
    """Counts the operations of this process and lets the fault happen."""

    def __init__(self, fault: Fault) -> None:
        self.fault, self.count, self.busy, self.shift = fault, -1, False, 0.0
        self.log = os.open(fault.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self.random = random.Random(fault.clock)
        self.write, self.open, self.fsync = os.write, io.open, os.fsync
        self.utime, self.time = os.utime, time.time

    def install(self) -> None:
        io.open = builtins.open = self._open  # type: ignore[assignment]
        os.fsync, os.write = self._fsync, self._write  # type: ignore[assignment]
        if self.fault.clock >= 0:
            time.time = lambda: self.time() + self.shift
            time.time_ns = lambda: int(time.time() * 1e9)
            os.utime = self._utime  # type: ignore[assignment]
        sys.addaudithook(self._audit)

    def _place(self, path: object, folder: object = -1) -> str | None:
        """Where an operation is, relative to the root; None if it is not below it."""
        if isinstance(path, int):
            try:
                full = os.readlink(f"/proc/self/fd/{path}")  # noqa: PTH115
            except OSError:
                return None
        else:
            text = os.fsdecode(path)  # type: ignore[arg-type]
            handle = f"/proc/self/fd/{folder}"
            base = "" if folder in (-1, None) else os.readlink(handle)  # noqa: PTH115
            full = os.path.abspath(os.path.join(base, text))  # noqa: PTH100, PTH118
        if full != self.fault.root and not full.startswith(self.fault.root + os.sep):
            return None
        return os.path.relpath(full, self.fault.root)

    def _audit(self, event: str, details: tuple[Any, ...]) -> None:
        if self.busy:
            return
        if event == "open":
            path, _, flags = details
            if not isinstance(path, (str, bytes, os.PathLike)) or not flags & WRITING:
                return
            self._operation("open", path)
        elif event in EVENTS:
            folder = details[1] if event in ("os.remove", "os.rmdir") else -1
            folder = details[2] if event == "os.mkdir" else folder
            # Where something is put counts, not where it comes from.
            path = details[1] if event in ("os.rename", "os.link", "os.symlink") else details[0]
            self._operation(event[3:], path, folder)

    def _operation(self, what: str, path: object, folder: object = -1) -> bool:
        """Count an operation; True if a write is to be cut in half, then ``_strike`` follows."""
        self.busy = True
        try:
            place = self._place(path, folder)
            if place is None:
                return False
            self.write(self.log, f"{what} {place}\n".encode())
            now = alike(what, place) == self.fault.site
            self.count += now
            if self.fault.clock >= 0:
                self.shift = self.random.uniform(-YEARS, YEARS)
            spared = self.fault.error == "ENOSPC" and what in ("remove", "rmdir", "utime")
            later = self.fault.lasting and self.count >= self.fault.at and not spared
            if not later and not (now and self.count == self.fault.at):
                return False
            if what == "write" and (self.fault.half or self.fault.error):
                return True
            self._strike()
            return False
        finally:
            self.busy = False

    def _strike(self) -> None:
        if self.fault.error:
            number = getattr(errno, self.fault.error)
            raise OSError(number, os.strerror(number))
        os.kill(os.getpid(), self.fault.signal)
        if self.fault.signal == signal.SIGKILL:
            signal.pause()

    def _open(self, file: Any, mode: str = "r", *more: Any, **options: Any) -> Any:
        stream = self.open(file, mode, *more, **options)
        place = self._place(file) if set(mode) & set("wax+") else None
        return stream if place is None else _Stream(stream, file, self)

    def written(self, path: object, data: Any, put: Any, flush: Any) -> Any:
        """Write through ``put``, or half of it and then the fault."""
        if self._operation("write", path):
            put(data[: len(data) // 2])
            flush()
            self._strike()
            data = data[len(data) // 2 :]
        return put(data)

    def _write(self, handle: int, data: bytes) -> int:
        return int(self.written(handle, data, lambda part: self.write(handle, part), lambda: None))

    def _fsync(self, handle: Any) -> None:
        number = handle if isinstance(handle, int) else handle.fileno()
        self._operation("fsync", number)
        self.fsync(number)

    def _utime(self, path: Any, times: Any = None, **more: Any) -> None:
        if times is None and "ns" not in more:
            times = (time.time(), time.time())
        self.utime(path, times, **more)


class _Stream:
    """A stream whose writes are counted."""

    def __init__(self, stream: Any, path: Any, injector: Injector) -> None:
        self._stream, self._path, self._injector = stream, path, injector

    def write(self, data: Any) -> Any:
        inner = self._stream
        return self._injector.written(self._path, data, inner.write, inner.flush)

    def close(self) -> None:
        closed = self._stream.closed
        self._stream.close()
        if self._injector.fault.clock >= 0 and not closed and os.path.exists(self._path):  # noqa: PTH110
            now = time.time()
            self._injector.utime(self._path, (now, now))

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def alike(what: str, place: str) -> str:
    """An operation without the numbers of processes, iterations and fingerprints in its place."""
    return f"{what} " + re.sub(r"(?<![a-z])[0-9a-f]*\d[0-9a-f]*", "#", place)


def operations(log: Path) -> list[str]:
    """What a trial did, as ``alike`` writes it."""
    return [alike(*line.split(" ", 1)) for line in log.read_text().splitlines()]
