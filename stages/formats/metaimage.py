"""MetaImage: samples after their header (.mha), or in files that the header names (.mhd)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..mesh.polygons import Floats
from . import detached, packed
from .sample_grid import Samples, count_of, placed

ENDINGS = (".mha", ".mhd")
HEADER = 2**22
"""Largest size of the header, in bytes."""
_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4",
    "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""NumPy's name for each type. MET_LONG has four bytes, as MetaIO writes it on every system."""


def read(path: Path) -> Samples:
    """The samples in ITK's coordinates. For a patient, x is to the left, y to the back, z up.

    Raises ValueError if the file is not a grid of numbers.
    """
    raw = packed.content(path)
    fields, names, at = _header(raw)
    if fields.get("ndims") != "3" or fields.get("elementnumberofchannels", "1") != "1":
        raise ValueError("it is not a grid of three dimensions with one number for each sample")
    shape = tuple(int(size) for size in fields["dimsize"].split())
    count = count_of(shape)
    kind = _TYPES.get(fields["elementtype"].upper())
    if kind is None:
        raise ValueError(f"its samples are {fields['elementtype']}, which is not read")
    big = _first(fields, "binarydatabyteordermsb", "elementbyteordermsb") or "False"
    layout = np.dtype((">" if _true(big) else "<") + kind)
    text = not _true(fields.get("binarydata", "True"))
    size = None if text else count * layout.itemsize
    window = 47 if _true(fields.get("compresseddata", "False")) else None
    skip = int(fields.get("headersize", "0"))
    if names:
        body = detached.read(path, names, size, 0, skip, window)
    else:
        body = detached.part(raw[at:], size, 0, 0, window)
    if text:
        flat = np.array(body.split(maxsplit=count)[:count], dtype=np.float64)
    else:
        flat = np.frombuffer(body, layout, count)
    origin = _numbers(_first(fields, "offset", "position", "origin") or "0 0 0", 3)
    spacing = _numbers(_first(fields, "elementspacing", "elementsize") or "1 1 1", 3)
    turned = _first(fields, "transformmatrix", "rotation", "orientation") or "1 0 0 0 1 0 0 0 1"
    # Each three successive numbers are the direction of one axis of the samples.
    axes = _numbers(turned, 9).reshape(3, 3).T
    return placed(flat.reshape(shape, order="F"), origin, axes * spacing)


def files_beside(path: Path) -> list[Path]:
    """The files with the data of the header at ``path``, if it can be read and names any.

    Raises OSError, and the errors of ``packed.beginning``.
    """
    try:
        return [path.parent / name for name in _header(packed.beginning(path, HEADER))[1]]
    except (ValueError, KeyError):
        return []


def _header(raw: bytes) -> tuple[dict[str, str], list[str], int]:
    """The fields of a header by name in lower case, the names of its data files, and where data
    begin.

    There are no names if the data follow the header in the same file.
    """
    fields: dict[str, str] = {}
    at = 0
    while "elementdatafile" not in fields:
        end = raw.find(b"\n", at, HEADER)
        if end < 0:
            raise ValueError("its header has no ElementDataFile")
        name, mark, value = raw[at:end].decode("utf-8", errors="replace").partition("=")
        at = end + 1
        if mark:
            fields[name.strip().lower()] = value.strip()
    place = fields["elementdatafile"]
    words = place.split()
    if place.upper() == "LOCAL":
        return fields, [], at
    if words[:1] == ["LIST"]:
        if words[1:] not in ([], ["2D"]):
            raise ValueError(f"its data lie in files as {place}, which is not read")
        listed = raw[at:HEADER].decode("utf-8", errors="replace").splitlines()
        names = [name.strip() for name in listed if name.strip()]
        if not names:
            raise ValueError("its LIST has no names of files")
        return fields, names, at
    if "%" in place and len(words) in (3, 4):
        first, last, step = (int(word) for word in [*words[1:], "1"][:3])
        return fields, detached.numbered(words[0], first, last, step), at
    if not place:
        raise ValueError("its ElementDataFile is empty")
    return fields, [place], at


def _first(fields: dict[str, str], *names: str) -> str | None:
    return next((fields[name] for name in names if name in fields), None)


def _true(word: str) -> bool:
    return word[:1].upper() in ("T", "1")


def _numbers(text: str, count: int) -> Floats:
    numbers = np.array(text.split(), dtype=np.float64)
    if len(numbers) != count:
        raise ValueError(f"{text[:60]} are not {count} numbers")
    return numbers
