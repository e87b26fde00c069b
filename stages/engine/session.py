"""The settings that apply to every stage that a command runs."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from ..artifacts.run_folder import RunFolder
from ..inputs.resolve import Identity
from ..progress import Progress, Silent


def available_threads() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Session:
    """The settings of a command line that apply to every stage it runs."""

    folder: RunFolder
    input: Identity | None = None
    seed: int = 0
    threads: int = field(default_factory=available_threads)
    device: str = "cpu"
    backend: str = "scipy"
    allow_code: bool = False
    """Whether a field may be Python code."""
    max_memory_mb: float | None = None
    """Largest expected memory of a stage in MB; None for the free memory."""
    force: bool = False
    touch: bool = False
    verify: bool = False
    progress: Progress = field(default_factory=Silent)
