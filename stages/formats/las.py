"""LAS and LAZ: points of laser scans, read with laspy and lazrs."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from . import scan_child
from .arrays_file import LARGEST
from .text_table import Table

ENDINGS = (".las", ".laz")
CHUNK = 1_000_000
"""Number of points that are unpacked at a time."""
DENSEST = 8
"""Largest number of points per byte that a compressed file can have. A header that
promises more is damaged."""
RECORD = 54
"""Number of bytes of the shortest record of variable length."""
NOISE = (7, 18)
"""Classes of points that the maker of the file marked as noise."""


def read(path: Path) -> Table:
    """The points, scaled and shifted as the header says, in double precision.

    Points that are withheld or marked as noise are left out. Raises BackendMissing if laspy or
    lazrs is not installed, and ValueError if the file is damaged.
    """
    return scan_child.read(path, "las", ("laspy", "lazrs"))


def points(path: Path) -> tuple[Floats, str]:
    """The points ``(N, 3)`` and a note about them, for ``read``. It runs in the child process.

    Raises whatever laspy and lazrs raise for damaged files.
    """
    import laspy

    # The checks below replace its log messages.
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    found, there = [np.zeros((0, 3))], 0
    _check_records(path)
    with laspy.open(path) as file:
        count = int(file.header.point_count)
        if count > LARGEST // 3:
            raise ValueError(f"{count} points are more than {LARGEST // 3}; thin them")
        if count > DENSEST * path.stat().st_size:
            raise ValueError(f"its header promises {count} points, more than it has room for")
        for chunk in file.chunk_iterator(CHUNK):
            at = np.stack([np.asarray(chunk[axis]) for axis in "xyz"], axis=1)
            found.append(at[_kept(chunk)])
            there += len(at)
    if there < count:
        raise ValueError(f"it ends early: {there} of {count} points are there")
    kept = np.concatenate(found)
    left_out = there - len(kept)
    note = f"{left_out} points are left out: withheld, or classified as noise" if left_out else ""
    return kept, note


def _check_records(path: Path) -> None:
    """Raise ValueError if the header promises more records than the file has room for.

    laspy would create all of them.
    """
    with path.open("rb") as file:
        head = file.read(247)
    records = int.from_bytes(head[100:104], "little")
    if head[24:26] >= b"\x01\x04":
        records += int.from_bytes(head[243:247], "little")
    if records * RECORD > path.stat().st_size:
        raise ValueError(f"its header promises {records} records, more than it has room for")


def _kept(chunk: Any) -> NDArray[np.bool_]:
    noise = np.isin(np.asarray(chunk["classification"]), NOISE)
    return np.asarray(~noise & ~np.asarray(chunk["withheld"], dtype=bool))
