"""Tells whether a process still runs, even if its number was given to another process."""

from __future__ import annotations

import contextlib
from pathlib import Path


def start_of(pid: int) -> str | None:
    """A value that distinguishes a process from others with the same number;
    None if it is not known."""
    # The time of day may jump, so that this is the machine's start and the ticks since then.
    with contextlib.suppress(OSError, IndexError):
        ticks = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[19]
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}:{ticks}"
    import psutil

    try:
        return str(psutil.Process(pid).create_time())
    except psutil.Error:
        return None


def runs(pid: int, start: str | None = None) -> bool:
    """Whether a process with this number runs on this machine and has the given ``start``."""
    import psutil

    if pid <= 0 or pid >= 2**31 or not psutil.pid_exists(pid):
        return False
    return start is None or start_of(pid) in (start, None)
