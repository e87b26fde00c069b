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
    whole = folder / f"{NAME}.{os.getpid()}"
    try:
        # Linked into place, the lock never is an empty file.
        whole.write_text(mine)
        while True:
            try:
                os.link(whole, path)
                break
            except FileExistsError:
                warnings += _take_over(path)
    except OSError as error:
        raise UsageError(
            f"{folder}: cannot be written to ({error.strerror}); choose another --run"
        ) from error
    finally:
        whole.unlink(missing_ok=True)
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
    """Remove the lock at ``path`` if its holder no longer runs."""
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return []
    try:
        holder = json.loads(text)
        host, pid = str(holder["host"]), int(holder["pid"])
    except (ValueError, KeyError, TypeError):
        raise Locked(f"{path}: is no lock of ours; delete the file") from None
    if host != socket.gethostname():
        raise Locked(f"{path}: held by process {pid} on {host}; wait, or delete the file")
    # Our own number on a lock that is not ours: a container that counts from 1 again.
    mine = pid == os.getpid() and path not in _HELD
    if process_runs(pid) and not mine:
        raise Locked(f"{path}: held by process {pid}; wait for it, or stop it")
    aside = path.with_name(f"{NAME}.dead.{os.getpid()}")
    try:
        os.replace(path, aside)
    except FileNotFoundError:
        return []  # somebody else was faster
    taken = aside.read_bytes()
    if taken != text:
        # Between our look and our move a living process had taken it: give it back.
        os.replace(aside, path)
        return []
    aside.unlink(missing_ok=True)
    return [f"took over the lock of process {pid}, which no longer runs"]
