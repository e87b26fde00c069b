"""How the command ends on a signal: at once, or at the next checkpoint."""

from __future__ import annotations

import os
import signal

from vorolight.stages.artifacts import lock, requeue
from vorolight.stages.errors import Stopped

GRACE = 60
"""Seconds within which a process must reach a checkpoint after SIGUSR1."""


def install() -> None:
    """SIGTERM and SIGINT end the process at once. SIGUSR1 ends it at the next checkpoint, before
    the next stage or after GRACE, whichever comes first."""
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    if hasattr(signal, "SIGUSR1"):
        signal.signal(signal.SIGUSR1, _stop_at_checkpoint)
        signal.signal(signal.SIGALRM, _stop_without)


def _stop(number: int, frame: object) -> None:
    _end(128 + number, "stopped")


def _stop_at_checkpoint(number: int, frame: object) -> None:
    requeue.ask()
    signal.alarm(GRACE)


def _stop_without(number: int, frame: object) -> None:
    _end(Stopped.exit_code, "stopped; no checkpoint was reached in time")


def _end(code: int, text: str) -> None:
    """End the process without unwinding: an exception in torch's kernels would crash it, and every
    file is either complete or missing."""
    lock.release_all()
    os.write(2, f"\nvorolight: {text}; the same command continues\n".encode())
    os._exit(code)
