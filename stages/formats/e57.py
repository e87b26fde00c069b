"""E57: laser scans with their poses, read with pye57."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..mesh.polygons import Floats
from . import scan_child
from .arrays_file import LARGEST
from .text_table import Table


def read(path: Path) -> Table:
    """The points of all scans in the common axes of the file, without those that are marked as
    invalid.

    Raises BackendMissing if pye57 is not installed, and ValueError if the file is damaged.
    """
    return scan_child.read(path, "e57", ("pye57",))


def points(path: Path) -> tuple[Floats, str]:
    """The points ``(N, 3)`` and a note about them, for ``read``. It runs in the child process.

    Raises whatever pye57 raises for damaged files.
    """
    import pye57

    found = [np.zeros((0, 3))]
    file = pye57.E57(str(path))
    counts = [int(file.get_header(k).point_count) for k in range(file.scan_count)]
    total = sum(counts)
    if total > LARGEST // 3:
        raise ValueError(f"{total} points are more than {LARGEST // 3}; thin them")
    for k, count in enumerate(counts):
        if count:
            scan = file.read_scan(k, ignore_missing_fields=True)
            axes = [scan[f"cartesian{axis}"] for axis in "XYZ"]
            found.append(np.stack(axes, axis=1).astype(np.float64))
    file.close()
    kept = np.concatenate(found)
    left_out = total - len(kept)
    note = f"{left_out} points are left out: they are marked as invalid" if left_out else ""
    return kept, note
