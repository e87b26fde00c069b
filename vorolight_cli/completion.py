"""What a shell offers as the value of an option."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

Completion = Callable[[str], list[str]]


def choices(found: Callable[[], Iterable[str]]) -> Completion:
    """Offers the values of ``found``, which is called only when a shell asks."""

    def complete(incomplete: str) -> list[str]:
        return [value for value in found() if value.startswith(incomplete)]

    return complete


def kinds() -> Iterable[str]:
    from vorolight.stages.inputs.resolve import KINDS

    return KINDS


def backends() -> Iterable[str]:
    from vorolight.stages.voronoi.diagram.delaunay import BACKENDS

    return BACKENDS


def samples() -> Iterable[str]:
    from vorolight.stages.inputs.samples import SAMPLES

    return SAMPLES


def stages() -> Iterable[str]:
    from vorolight.stages.engine.registry import ORDER

    return ORDER


def input_field(incomplete: str) -> list[str]:
    """Offers built-in fields if no file begins with these letters; otherwise the shell offers the
    files."""
    from vorolight.stages.inputs.field.source import FIELDS

    if not incomplete or any(Path().glob(f"{incomplete}*")):
        return []
    return [name for name in FIELDS if name.startswith(incomplete)]
