"""Estimate the memory that a stage will need, and refuse a stage that needs more than there is."""

from __future__ import annotations

import sys
from pathlib import Path

from .errors import UsageError

CONTROL_GROUP = Path("/sys/fs/cgroup")
"""Where Linux gives the memory limit of a container."""


def free_mb() -> float:
    """Memory that this process may still use, in MB: that of the machine or of its container."""
    import psutil

    free = float(psutil.virtual_memory().available)
    try:
        most, used = (
            float((CONTROL_GROUP / name).read_text()) for name in ("memory.max", "memory.current")
        )
    except (OSError, ValueError):  # no such limit
        most, used = free, 0.0
    return min(free, max(0.0, most - used)) / 1e6


def require(stage: str, needed_mb: float, most_mb: float | None) -> None:
    """Raises UsageError if ``needed_mb`` is more than ``most_mb``, or than is free (None)."""
    limit = free_mb() if most_mb is None else most_mb
    if needed_mb <= limit:
        return
    have = (
        f"only {limit / 1000:.1f} GB are free: lower -n, use a machine with more memory, or "
        "allow it with --max-memory"
        if most_mb is None
        else f"--max-memory allows {limit / 1000:.1f} GB: lower -n, or raise it"
    )
    raise UsageError(f"{stage}: needs about {needed_mb / 1000:.1f} GB of memory, but {have}")


def peak(least: float, start: float, each: float, count: float) -> float:
    """MB: ``start`` and ``each`` kB for each of ``count``, but at least ``least``, which loading
    libraries takes.

    The figures of the stages are fits to what ``make bench-stages`` measures, rounded up.
    """
    return max(least, start + 1e-3 * each * count)


def peak_mb() -> float | None:
    """Peak resident memory of this process so far, in MB; None if the system does not report it."""
    try:
        # Not getrusage: its value survives exec, so it may be the memory of the parent process.
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").split("\n")
        return round(next(float(x.split()[1]) for x in lines if x.startswith("VmHWM")) / 1024, 1)
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024**2 if sys.platform == "darwin" else 1024), 1)
