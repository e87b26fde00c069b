"""The wish that this process stops where it can go on: a cluster has it before a time limit."""

from __future__ import annotations

from ..errors import Stopped

_asked = False


def ask() -> None:
    """From now on the next checkpoint, or the start of the next stage, ends the process."""
    global _asked
    _asked = True


def asked() -> bool:
    return _asked


def stop_if_asked() -> None:
    """Raises Stopped once ``ask`` was called."""
    if _asked:
        raise Stopped("stopped at a checkpoint; the same command continues from there")
