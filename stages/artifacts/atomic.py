"""The only writer of files. A file is either unchanged, or new and complete."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

from ..errors import UsageError
from . import processes

_TEMPORARY = re.compile(r"^\.(?:.+\.tmp|lock(?:\.dead)?)\.(\d{1,10})$")
STAGING = ".new"
"""Suffix of the folder that collects the files of a stage until all are complete."""


def write(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data``: write a temporary file, sync it, rename it, and sync the
    folder.

    Raises UsageError if the folder cannot be written to.
    """
    temporary = path.with_name(f".{path.name}.tmp.{os.getpid()}")
    try:
        try:
            with open(temporary, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        finally:
            discard(temporary)
        _sync_folder(path.parent)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be written ({error.strerror}); choose a folder you can write to"
        ) from error


def discard(path: Path) -> None:
    """Remove a leftover file. If that fails, the next start tries again."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file if it exists. Raises UsageError if that is not allowed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be removed ({error.strerror}); check its permissions"
        ) from error


def move(source: Path, target: Path) -> None:
    """Replace ``target`` by the finished file ``source`` of the same file system."""
    try:
        os.replace(source, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise UsageError(
            f"{target}: cannot be written ({error.strerror}); check its permissions"
        ) from error


def touch(path: Path, later_than: Iterable[Path] = ()) -> None:
    """Set a file's modification time to now, or to that of the newest of ``later_than`` if this is
    later.

    It is later if the clock was set back. Raises UsageError if that is not allowed.
    """
    try:
        now = max([time.time_ns(), *(other.stat().st_mtime_ns for other in later_than)])
        os.utime(path, ns=(now, now))
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be touched ({error.strerror}); check its permissions"
        ) from error


def make_folder(path: Path) -> None:
    """Create ``path`` and its parents. Raises UsageError if that is not allowed."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be created ({error.strerror}); choose another folder"
        ) from error


def sweep(folder: Path) -> None:
    """Remove temporary files and unfinished folders of processes that no longer run.

    Only the process that holds the folder's lock may call this.
    """
    for entry in folder.glob(".*"):
        match = _TEMPORARY.match(entry.name)
        if match and not processes.runs(int(match.group(1))):
            discard(entry)
        elif entry.name.endswith(STAGING) and entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
