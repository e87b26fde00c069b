"""LAS and LAZ: points of laser scanning, by laspy and lazrs."""

from __future__ import annotations

import importlib.util
import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BackendMissing
from . import packed
from .arrays_file import LARGEST
from .text_table import Table

ENDINGS = (".las", ".laz")
CHUNK = 1_000_000
"""Points that are unpacked at a time."""
NOISE = (7, 18)
"""Classes of points that whoever made the file took for noise."""
MISSING = "{} is read by {}, which is not installed: pip install 'vorolight[scans]'"


def read(path: Path) -> Table:
    """The points, their whole numbers scaled and shifted as the header says, in double precision;
    those that are withheld or of a class of noise are left out.

    Raises BackendMissing without laspy or lazrs, ValueError for damaged files.
    """
    for name in ("laspy", "lazrs"):
        if importlib.util.find_spec(name) is None:
            raise BackendMissing(f"{path}: " + MISSING.format("LAS and LAZ", name))
    import laspy

    # What laspy logs is said below.
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    source: Any = io.BytesIO(packed.content(path)) if packed.is_packed(path) else path
    found, count, there = [np.zeros((0, 3))], 0, 0
    try:
        with laspy.open(source) as file:
            count = file.header.point_count
            if count > LARGEST // 3:
                raise ValueError(f"{count} points are more than {LARGEST // 3}; thin them")
            for chunk in file.chunk_iterator(CHUNK):
                points = np.stack([np.asarray(chunk[axis]) for axis in "xyz"], axis=1)
                found.append(points[_kept(chunk)])
                there += len(points)
        if there < count:
            raise ValueError(f"it ends early: {there} of {count} points are there")
    # laspy raises whatever the damaged bytes lead it to, and lazrs errors that are no exceptions
    # of Python's.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error
    points = np.concatenate(found)
    left_out = count - len(points)
    note = f"{left_out} points are left out: withheld, or classified as noise" if left_out else ""
    return Table(points, None, note)


def _kept(chunk: Any) -> NDArray[np.bool_]:
    noise = np.isin(np.asarray(chunk["classification"]), NOISE)
    return np.asarray(~noise & ~np.asarray(chunk["withheld"], dtype=bool))
