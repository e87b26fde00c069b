"""Whether a process still runs, also where its number has been given to another one."""

from __future__ import annotations

import contextlib
from pathlib import Path


def start_of(pid: int) -> str | None:
    """What tells a process from another of the same number; None where that cannot be known."""
    # Not the time of day, which may jump: ticks since the machine was started, and which start.
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
    """Whether a process of this number runs on this machine, and is the one of that ``start``."""
    import psutil

    if pid <= 0 or pid >= 2**31 or not psutil.pid_exists(pid):
        return False
    return start is None or start_of(pid) in (start, None)
