"""The result of a check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """The result of a check.

    ``verdict`` is ok, note (an optional part is missing, or something is worth knowing) or problem.
    ``advice`` says what to do.
    """

    name: str
    found: str
    verdict: str = "ok"
    advice: str | None = None
