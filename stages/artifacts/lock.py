"""A lock: only one process may work on a run folder at a time."""

from __future__ import annotations

import errno
import json
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import Locked, UsageError
from . import atomic, processes

NAME = ".lock"
_HELD: set[Path] = set()
JOB = ("SLURM_CLUSTER_NAME", "SLURM_JOB_ID")
"""Environment variables that name a job of a cluster. Such a job never runs twice at once, and may
be started again on another node."""


@contextmanager
def locked(folder: Path) -> Iterator[list[str]]:
    """Hold the lock of ``folder``; yields warnings about a lock that was taken over.

    Raises Locked while another process of this host, or any process of another host, has it.
    """
    path = folder / NAME
    mine = json.dumps(_holder())
    warnings: list[str] = []
    whole = folder / f"{NAME}.{os.getpid()}"
    try:
        # The lock is linked into place, so it is never an empty file.
        whole.write_text(mine)
        while True:
            try:
                _put(whole, path)
                break
            except FileExistsError:
                warnings += _take_over(path)
    except OSError as error:
        raise UsageError(
            f"{folder}: cannot be written to ({error.strerror}); choose another --run"
        ) from error
    finally:
        atomic.discard(whole)
    _HELD.add(path)
    try:
        yield warnings
    finally:
        _HELD.discard(path)
        atomic.discard(path)


def _put(whole: Path, path: Path) -> None:
    """Create ``path`` with the content of ``whole``. Raises FileExistsError if it exists."""
    try:
        os.link(whole, path)
    except FileExistsError:
        raise
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        with open(path, "x") as stream:  # this file system has no hard links
            stream.write(whole.read_text())


def release_all() -> None:
    """Release every lock of this process, for an end without unwinding."""
    for path in _HELD:
        atomic.discard(path)


def _holder() -> dict[str, Any]:
    job = [os.environ.get(name, "") for name in JOB]
    return {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "start": processes.start_of(os.getpid()),
        "job": ":".join(job) if job[-1] else None,
    }


def holder(folder: Path) -> dict[str, Any] | None:
    """The process that holds the lock of ``folder``, if it still runs or is on another host."""
    try:
        found = json.loads(_content(folder / NAME))
        here = str(found["host"]) == socket.gethostname()
        gone = here and not processes.runs(int(found["pid"]), found.get("start"))
    except (Locked, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return None if gone else {"host": str(found["host"]), "pid": int(found["pid"])}


def _content(path: Path) -> bytes:
    """The content of a lock. Raises Locked if it is not a file, since reading a
    pipe would never end."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise Locked(f"{path}: is not a lock file of vorolight; delete it")
    return path.read_bytes()


def _take_over(path: Path) -> list[str]:
    """Remove the lock at ``path`` if its holder no longer runs."""
    try:
        text = _content(path)
    except FileNotFoundError:
        return []
    try:
        holder = json.loads(text)
        host, pid = str(holder["host"]), int(holder["pid"])
        job, start = holder.get("job"), holder.get("start")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise Locked(f"{path}: is not a lock file of vorolight; delete it") from None
    ours = _holder()
    # Only one job has a number. If it was started again, the process with the lock is dead.
    again = job is not None and job == ours["job"] and (host, pid) != (ours["host"], ours["pid"])
    if host != ours["host"] and not again:
        raise Locked(
            f"{path}: process {pid} on {host} works on this run folder; wait for it, or delete "
            "the file if that process has ended"
        )
    # After a restart, or in a container, a number may belong to another process.
    if host == ours["host"] and processes.runs(pid, start):
        raise Locked(f"{path}: process {pid} works on this run folder; wait for it, or stop it")
    aside = path.with_name(f"{NAME}.dead.{os.getpid()}")
    try:
        os.replace(path, aside)
    except FileNotFoundError:
        return []  # another process was faster
    taken = _content(aside)
    if taken != text:
        # Another process took the lock since we examined it, so that it gets it back.
        os.replace(aside, path)
        return []
    atomic.discard(aside)
    return [f"took over the lock of process {pid}, which no longer runs"]
