"""Stops at the next checkpoint, as a cluster requests before its time limit."""

from __future__ import annotations

from ..errors import Stopped

_asked = False


def ask() -> None:
    """End the process at the next checkpoint, or at the start of the next stage."""
    global _asked
    _asked = True


def asked() -> bool:
    """Whether ``ask`` was called."""
    return _asked


def stop_if_asked() -> None:
    """Raise Stopped if ``ask`` was called."""
    if _asked:
        raise Stopped("stopped at a checkpoint; the same command continues from there")
