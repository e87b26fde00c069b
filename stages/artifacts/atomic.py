"""The one writer: a file is either as it was or whole and new."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..errors import UsageError

_TEMPORARY = re.compile(r"^\..+\.tmp\.(\d+)$")


def write(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data``: temporary file in the same folder, fsync, rename, fsync.

    Raises UsageError when the folder cannot be written to.
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
            temporary.unlink(missing_ok=True)
        _sync_folder(path.parent)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be written ({error.strerror}); choose a folder you can write to"
        ) from error


def move(source: Path, target: Path) -> None:
    """Replace ``target`` by the finished file ``source`` of the same file system."""
    try:
        os.replace(source, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise UsageError(f"{target}: cannot be written ({error.strerror})") from error


def touch(path: Path) -> None:
    """Renew a file's modification time. Raises UsageError when that is not allowed."""
    try:
        os.utime(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be touched ({error.strerror})") from error


def make_folder(path: Path) -> None:
    """Create ``path`` and its parents. Raises UsageError when that is not allowed."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be created ({error.strerror}); choose another folder"
        ) from error


def sweep(folder: Path) -> None:
    """Remove temporary files left by processes that no longer run."""
    for entry in folder.glob(".*.tmp.*"):
        match = _TEMPORARY.match(entry.name)
        if match and not process_runs(int(match.group(1))):
            entry.unlink(missing_ok=True)


def process_runs(pid: int) -> bool:
    """Whether a process of this number runs on this machine."""
    if os.name == "nt":
        import ctypes

        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
        handle = kernel.OpenProcess(0x1000, False, pid)
        if handle:
            kernel.CloseHandle(handle)
        return bool(handle)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
