"""PTX: scans as text, each with a grid of directions and a transform."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..mesh.polygons import Floats
from . import packed
from .text_table import Table, text_of

HEAD = 10
"""Number of lines before the points of a scan: columns, rows, position and axes of the
scanner, and the transform."""
MOST_SCANS = 10_000


def read(path: Path) -> Table:
    """The points of all scans, each multiplied by its transform.

    Directions without an echo are stored as 0 0 0 and left out. Raises ValueError with the line and
    the fault.
    """
    lines = [line.strip() for line in text_of(packed.content(path)).splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    found: list[Floats] = []
    at = empty = 0
    while at < len(lines):
        if len(found) >= MOST_SCANS:
            raise ValueError(f"it holds more than {MOST_SCANS} scans")
        columns, rows = (int(_numbers(lines, at + k, 1)[0]) for k in range(2))
        transform = np.stack([_numbers(lines, at + 6 + k, 4) for k in range(4)])
        if columns < 0 or rows < 0 or not np.isfinite(transform).all():
            raise ValueError(f"line {at + 1} begins no scan")
        begin, end = at + HEAD, at + HEAD + columns * rows
        if end > len(lines):
            raise ValueError(
                f"its scan of {columns} x {rows} points in line {at + 1} ends early: "
                f"{len(lines) - begin} of {columns * rows} are there"
            )
        points = _points(lines, begin, end)
        echo = (points != 0).any(axis=1)
        empty += int((~echo).sum())
        # Points are rows, so that the translation is the last row of the transform.
        found.append(points[echo] @ transform[:3, :3] + transform[3, :3])
        at = end
    if not found:
        raise ValueError("it holds no scan")
    note = f"{len(found)} scans; {empty} directions without an echo are left out" if empty else ""
    return Table(np.concatenate(found), None, note)


def _points(lines: list[str], begin: int, end: int) -> Floats:
    """The first three numbers of each of these lines, ``(N, 3)``."""
    if begin == end:
        return np.zeros((0, 3))
    try:
        return np.loadtxt(lines[begin:end], usecols=(0, 1, 2), ndmin=2, comments=None)
    except ValueError:
        for k in range(begin, end):
            _numbers(lines, k, 3)
        raise


def _numbers(lines: list[str], at: int, count: int) -> Floats:
    """The first ``count`` numbers of a line."""
    words = lines[at].split()[:count] if at < len(lines) else []
    try:
        found = np.array(words, dtype=np.float64)
    except ValueError:
        found = np.zeros(0)
    if len(found) < count or (count == 1 and found[0] != np.floor(found[0])):
        shown = lines[at][:60] if at < len(lines) else "the end of the file"
        wanted = "a whole number" if count == 1 else f"{count} numbers"
        raise ValueError(f"line {at + 1} has no {wanted.removeprefix('a ')}: {shown}")
    return found
