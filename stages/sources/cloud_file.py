"""Reading point clouds: PLY, PCD, text (XYZ, PTS, ASC, CSV, TXT), NPY, NPZ and Expe's PTS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..export import ply
from ..surface.polygons import Floats
from . import text_table
from .arrays_file import named_arrays, single_array
from .text_table import Table

TEXT = (".xyz", ".xyzn", ".pts", ".asc", ".csv", ".txt")
FEWEST, MOST = 100, 2_000_000
"""Points that a surface can be made of; of more, so many are taken."""
FLAT = 1e-5
"""Extent across the plane of the points, over the largest, below which they are flat."""
EXPE = b"[Expe/PointSet/Binary/0.1]"


@dataclass(frozen=True)
class LoadedCloud:
    """The points of a file in its order, those that are not finite, or there again, left out."""

    points: Floats
    normals: Floats | None
    not_finite: int
    doubled: int
    thinned: int
    """Points left out at random because there were more than MOST."""
    note: str
    """What is to be said of the columns that were taken, if anything."""
    columns: tuple[int, ...]
    """Of a text: those that were taken, counted from 1 on."""


def load(path: Path, columns: str | None = None) -> LoadedCloud:
    """The cloud in ``path``; ``columns`` says which those of a text are, as --columns does.

    Raises InputError for files that are missing, empty or no cloud, for too few points and for
    points of one plane.
    """
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; export the points again")
        with np.errstate(all="ignore"):  # what is no number is found below
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
    # The squares of what is larger are not finite.
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
    suffix = path.suffix.lower()
    if suffix in TEXT:
        raw = path.read_bytes()
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
    raw = path.read_bytes()
    if suffix == ".pcd":
        return _pcd(raw)
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
    """Points, and normals if the rows of ``table (N, >= 3)`` have unit vectors after them."""
    if table.ndim != 2 or table.shape[1] < 3:
        raise ValueError(f"it has numbers of shape {table.shape}, not rows of x, y, z")
    if normals is not None:
        normals = _numbers(normals)
        if normals.shape != (len(table), 3):
            raise ValueError(f"'normals' has shape {normals.shape}, not that of the points")
    elif table.shape[1] == 6 and text_table.are_normals(table[:, 3:]):
        normals = table[:, 3:]
    return Table(table[:, :3], normals)


def _pcd(raw: bytes) -> Table:
    """A PCD of the Point Cloud Library, as text or binary; what is packed is not read."""
    fields: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in fields:
        end = raw.index(b"\n", at)
        words = raw[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            fields[words[0].upper()] = words[1:]
    names = [name.lower() for name in fields["FIELDS"]]
    if fields["DATA"][:1] == ["ascii"]:
        return text_table.read(" ".join(names).encode() + b"\n" + raw[at:])
    if fields["DATA"][:1] != ["binary"]:
        raise ValueError(f"its data are {' '.join(fields['DATA'])}; save them as binary or ascii")
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(names))]
    if not set(fields["SIZE"]) <= set("1248"):
        raise ValueError(f"its fields have sizes {' '.join(fields['SIZE'])}, not 1, 2, 4 or 8")
    kinds = {"F": "f", "I": "i", "U": "u"}
    if ("F", "1") in zip(fields["TYPE"], fields["SIZE"], strict=True):
        raise ValueError("it has floating-point numbers of one byte")
    layout = np.dtype(
        [
            (f"{name} {k}", f"<{kinds[kind]}{int(size)}", (count,))
            for k, (name, kind, size, count) in enumerate(
                zip(names, fields["TYPE"], fields["SIZE"], counts, strict=True)
            )
        ]
    )
    rows = np.frombuffer(raw, layout, int(fields["POINTS"][0]), at)

    def vectors(wanted: tuple[str, ...]) -> Floats | None:
        if not set(wanted) <= set(names):
            return None
        columns = [rows[f"{name} {names.index(name)}"][:, 0] for name in wanted]
        return np.stack(columns, axis=1).astype(np.float64)

    points = vectors(("x", "y", "z"))
    if points is None:
        raise ValueError("it has no fields x, y and z")
    return Table(points, vectors(("normal_x", "normal_y", "normal_z")))


def _expe(raw: bytes) -> tuple[Floats, Floats | None]:
    """The binary point sets of the Expe engine: records of little-endian floats."""
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
