"""LAS and LAZ: points of laser scanning, by laspy and lazrs."""

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
"""Points that are unpacked at a time."""
DENSEST = 8
"""Points a byte, of which files have one at the most: more are a damaged count."""
RECORD = 54
"""Bytes of the shortest record of variable length."""
NOISE = (7, 18)
"""Classes of points that whoever made the file took for noise."""


def read(path: Path) -> Table:
    """The points, their whole numbers scaled and shifted as the header says, in double precision;
    those that are withheld or of a class of noise are left out.

    Raises BackendMissing without laspy or lazrs, ValueError for damaged files.
    """
    return scan_child.read(path, "las", ("laspy", "lazrs"))


def points(path: Path) -> tuple[Floats, str]:
    """What ``read`` finds, ``(N, 3)``, and what is to be said of it, in the child process.

    Raises whatever laspy and lazrs do at damaged files.
    """
    import laspy

    # What it logs is said below.
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
    """Raise ValueError for a header that promises more records than the file has room for, which
    laspy would make nevertheless."""
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
