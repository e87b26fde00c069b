"""E57: scans with their poses, by pye57."""

from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path

import numpy as np

from ..errors import BackendMissing
from . import packed
from .arrays_file import LARGEST
from .las import MISSING
from .text_table import Table


def read(path: Path) -> Table:
    """The points of all scans, in the file's common axes; those marked as invalid are left out.

    Raises BackendMissing without pye57, ValueError for damaged files.
    """
    if importlib.util.find_spec("pye57") is None:
        raise BackendMissing(f"{path}: " + MISSING.format("E57", "pye57"))
    if not packed.is_packed(path):
        return _scans(path)
    # pye57 reads files only.
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "scan.e57"
        place.write_bytes(packed.content(path))
        return _scans(place)


def _scans(path: Path) -> Table:
    import pye57

    found, total = [np.zeros((0, 3))], 0
    try:
        file = pye57.E57(str(path))
        try:
            counts = [int(file.get_header(k).point_count) for k in range(file.scan_count)]
            total = sum(counts)
            if total > LARGEST // 3:
                raise ValueError(f"{total} points are more than {LARGEST // 3}; thin them")
            for k, count in enumerate(counts):
                if count:
                    scan = file.read_scan(k, ignore_missing_fields=True)
                    axes = [scan[f"cartesian{axis}"] for axis in "XYZ"]
                    found.append(np.stack(axes, axis=1).astype(np.float64))
        finally:
            file.close()
    # pye57 raises whatever the damaged bytes lead it to, and hides it behind errors of its own.
    except Exception as error:
        first: BaseException = error
        while first.__context__ is not None:
            first = first.__context__
        raise ValueError(str(first) or type(first).__name__) from error
    points = np.concatenate(found)
    left_out = total - len(points)
    note = f"{left_out} points are left out: they are marked as invalid" if left_out else ""
    return Table(points, None, note)
