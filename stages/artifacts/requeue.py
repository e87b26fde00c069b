"""Stopping at the next checkpoint, which a cluster requests before a time limit."""

from __future__ import annotations

from ..errors import Stopped

_asked = False


def ask() -> None:
    """Make the next checkpoint, or the start of the next stage, end the process."""
    global _asked
    _asked = True


def asked() -> bool:
    return _asked


def stop_if_asked() -> None:
    """Raise Stopped if ``ask`` was called."""
    if _asked:
        raise Stopped("stopped at a checkpoint; the same command continues from there")
