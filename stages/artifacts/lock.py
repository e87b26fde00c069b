"""One process at a time in a run folder."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import Locked, UsageError
from .atomic import process_runs

NAME = ".lock"
_HELD: set[Path] = set()


@contextmanager
def locked(folder: Path) -> Iterator[list[str]]:
    """Hold the lock of ``folder``; yields warnings about a lock that was taken over.

    Raises Locked while another process of this host, or any process of another host, holds it.
    """
    path = folder / NAME
    mine = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "start": time.time()})
    warnings: list[str] = []
    while True:
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            warnings += _take_over(path)
            continue
        except OSError as error:
            raise UsageError(
                f"{folder}: cannot be written to ({error.strerror}); choose another --run"
            ) from error
        with os.fdopen(handle, "w") as stream:
            stream.write(mine)
        break
    _HELD.add(path)
    try:
        yield warnings
    finally:
        _HELD.discard(path)
        path.unlink(missing_ok=True)


def release_all() -> None:
    """Give up every lock of this process, for one that ends without unwinding."""
    for path in _HELD:
        path.unlink(missing_ok=True)


def _take_over(path: Path) -> list[str]:
    try:
        text = path.read_text()
    except FileNotFoundError:
        return []
    try:
        holder = json.loads(text)
        host, pid = str(holder["host"]), int(holder["pid"])
    except (ValueError, KeyError, TypeError):
        # Being written this moment, or torn by a crash: a second look tells.
        time.sleep(0.2)
        try:
            torn = path.read_text() == text
        except FileNotFoundError:
            return []
        if torn:
            path.unlink(missing_ok=True)
            return ["a torn lock file was removed"]
        return []
    if host != socket.gethostname():
        raise Locked(f"{path}: held by process {pid} on {host}; wait, or delete the file")
    if process_runs(pid):
        raise Locked(f"{path}: held by process {pid}; wait for it, or stop it")
    path.unlink(missing_ok=True)
    return [f"took over the lock of process {pid}, which no longer runs"]
