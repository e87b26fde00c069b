"""Samples that are in other files than the header that names them."""

from __future__ import annotations

import zlib
from pathlib import Path

from .packed import MOST

MOST_FILES = 100_000


def numbered(pattern: str, first: int, last: int, step: int) -> list[str]:
    """The names that ``pattern``, such as ``slice%03d.raw``, gives for numbers from ``first`` to
    ``last``.

    Raises ValueError if there are too many, or if the pattern takes no number.
    """
    if step == 0 or abs(last - first) // abs(step) >= MOST_FILES:
        raise ValueError("its data lie in too many files")
    numbers = range(first, last + (1 if step > 0 else -1), step)
    try:
        return [pattern % number for number in numbers]
    except TypeError as error:
        raise ValueError(f"{pattern} names no files by number") from error


def read(
    header: Path,
    names: list[str],
    size: int | None,
    lines: int = 0,
    skip: int = 0,
    window: int | None = None,
) -> bytes:
    """``size`` bytes of data, or all if it is None, from the files ``names`` one after the other.

    Relative names are relative to the folder of ``header``. In each file, first ``lines`` lines and
    then ``skip`` bytes are left out; with -1, everything is left out but the file's share of
    ``size`` at its end. ``window`` is zlib's parameter if the data after the lines are compressed.
    Raises ValueError if a file is missing or ends early.
    """
    if not names or (size is not None and size % len(names)):
        raise ValueError(f"its data do not divide evenly into {len(names)} files")
    share = None if size is None else size // len(names)
    found = []
    for name in names:
        place = header.parent / name
        if not place.is_file():
            raise ValueError(f"its data are in {name}, which does not exist")
        if place.stat().st_size > 2 * MOST:
            raise ValueError(f"its data in {name} are more than {2 * MOST / 1e9:.0f} GB")
        found.append(part(place.read_bytes(), share, lines, skip, window))
    return b"".join(found)


def part(raw: bytes, size: int | None, lines: int, skip: int, window: int | None) -> bytes:
    """The data in the bytes of one file, as ``read`` describes. Raises
    ValueError if they end early."""
    if lines < 0 or skip < -1 or (skip == -1 and window is not None):
        raise ValueError(f"it leaves out {lines} lines and {skip} bytes")
    for _ in range(lines):
        _, mark, raw = raw.partition(b"\n")
        if not mark:
            break
    if window is not None:
        most = 0 if size is None else size + max(skip, 0)
        raw = zlib.decompressobj(window).decompress(raw, most)
    if skip == -1 and size is not None:
        raw = raw[max(0, len(raw) - size) :]
    else:
        raw = raw[max(skip, 0) :]
    if size is None:
        return raw
    if len(raw) < size:
        raise ValueError(f"it ends early: {len(raw)} of {size} bytes of data are there")
    return raw[:size]
