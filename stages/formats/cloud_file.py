"""Reads point clouds. The suffix of the file decides the format.

Text, PLY, NPY, NPZ and the PTS files of Expe are read here; other formats have modules of their
own. To add a format, write a function that reads a path and returns a ``Table``, and add it to
READERS under its suffix. ``kind_of`` in ``inputs/resolve.py`` then recognises it as a point cloud.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..mesh.polygons import Floats
from . import e57, las, packed, pcd, ply, ptx, text_table
from .arrays_file import named_arrays, single_array
from .text_table import Table

TEXT = (".xyz", ".xyzn", ".pts", ".asc", ".csv", ".txt")
READERS: dict[str, Callable[[Path], Table]] = {
    ".pcd": pcd.read,
    ".ptx": ptx.read,
    **dict.fromkeys(las.ENDINGS, las.read),
    ".e57": e57.read,
}
"""The readers of formats that contain only points, by suffix."""
FEWEST, MOST = 100, 2_000_000
"""Smallest number of points of a surface, and the largest number that is used of a cloud."""
FLAT = 1e-5
"""Points are in one plane if their extent across it, divided by the largest extent, is less."""
EXPE = b"[Expe/PointSet/Binary/0.1]"


@dataclass(frozen=True)
class LoadedCloud:
    """The points of a file in their order, without those that are not finite
    and without duplicates."""

    points: Floats
    normals: Floats | None
    not_finite: int
    doubled: int
    thinned: int
    """Number of points that were left out at random because there were more than MOST."""
    note: str
    """A sentence about the columns that were taken; empty if none is needed."""
    columns: tuple[int, ...]
    """The columns of a text file that were taken, counted from 1."""


def load(path: Path, columns: str | None = None) -> LoadedCloud:
    """The cloud in ``path``. ``columns`` names the columns of a text file, as ``--columns`` does.

    Raises InputError if the file is missing, empty or not a point cloud, if it has too few points,
    or if all are in one plane.
    """
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; export the points again")
        with np.errstate(all="ignore"):  # values that are not finite are found below
            table = _read(path, columns)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check it") from error
    except (ValueError, KeyError, IndexError, OverflowError, MemoryError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: not a readable point cloud ({reason[:120]}); export the points again"
        ) from error
    points, normals = table.points, table.normals
    count = len(points)
    # The squares of larger numbers would not be finite.
    finite = (np.abs(np.nan_to_num(points, nan=np.inf)) < 1e150).all(axis=1)
    _, first = np.unique(points[finite], axis=0, return_index=True)
    kept = np.flatnonzero(finite)[np.sort(first)]
    doubled, thinned = int(finite.sum()) - len(kept), max(0, len(kept) - MOST)
    if thinned:
        kept = np.sort(np.random.default_rng(0).choice(kept, MOST, replace=False))
    if len(kept) < FEWEST:
        raise InputError(
            f"{path}: has {len(kept)} different points, but a surface needs at least {FEWEST}"
        )
    points = np.ascontiguousarray(points[kept])
    centred = points - points.mean(axis=0)
    centred /= np.abs(centred).max()
    extent = np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1], axis=0)
    if extent.min() < FLAT * extent.max():
        raise InputError(f"{path}: the points lie in one plane, so they enclose nothing")
    if normals is not None:
        normals = np.nan_to_num(normals[kept], posinf=0.0, neginf=0.0)
    left_out = count - int(finite.sum())
    return LoadedCloud(points, normals, left_out, doubled, thinned, table.note, table.columns)


def _read(path: Path, columns: str | None) -> Table:
    suffix = packed.ending(path)
    if suffix in TEXT:
        raw = packed.content(path)
        return Table(*_expe(raw)) if raw.startswith(EXPE) else text_table.read(raw, columns)
    if columns is not None:
        raise ValueError(f"--columns applies to text files only ({', '.join(TEXT)})")
    if suffix == ".npz":
        arrays = named_arrays(path)
        if "points" not in arrays:
            raise InputError(
                f"{path}: has no array called 'points'; save the points under this name"
            )
        return _split(_numbers(arrays["points"]), arrays.get("normals"))
    if suffix == ".npy":
        return _split(_numbers(single_array(path)), None)
    if suffix in READERS:
        return READERS[suffix](path)
    raw = packed.content(path)
    if suffix == ".ply":
        return Table(*ply.decode_points(raw))
    if raw.startswith(EXPE):
        return Table(*_expe(raw))
    from .mesh_file import vertices_of

    return Table(vertices_of(path), None)


def _numbers(values: NDArray[Any]) -> Floats:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"it has values of type {values.dtype}, not numbers")
    return np.asarray(values, dtype=np.float64)


def _split(table: Floats, normals: Any) -> Table:
    """Points, and normals if the columns after the points in
    ``table (N, >= 3)`` are unit vectors."""
    if table.ndim != 2 or table.shape[1] < 3:
        raise ValueError(f"it has numbers of shape {table.shape}, not rows of x, y, z")
    if normals is not None:
        normals = _numbers(normals)
        if normals.shape != (len(table), 3):
            raise ValueError(f"'normals' has shape {normals.shape}, not that of the points")
    elif table.shape[1] == 6 and text_table.are_normals(table[:, 3:]):
        normals = table[:, 3:]
    return Table(table[:, :3], normals)


def _expe(raw: bytes) -> tuple[Floats, Floats | None]:
    """Points and normals of a binary point set of the Expe engine: records of
    little-endian floats."""
    head, mark, body = raw.partition(b"\ndata\n")
    fields, count = [], -1
    for line in head.decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["property"] and len(words) == 3:
            fields.append((words[1], f"V{int(words[2])}"))
        elif words[:1] == ["nofpoints"]:
            count = int(words[1])
    layout = np.dtype(fields)
    if (
        not mark
        or count < 0
        or count * layout.itemsize > len(body)
        or "position" not in dict(fields)
    ):
        raise ValueError("its header does not fit its data")
    records = np.frombuffer(body, layout, count)

    def vectors(name: str) -> Floats:
        flat = np.frombuffer(np.ascontiguousarray(records[name]).tobytes(), "<f4")
        return flat.reshape(count, 3).astype(np.float64)

    return vectors("position"), vectors("normal") if "normal" in dict(fields) else None
