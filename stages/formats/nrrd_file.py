"""NRRD: samples after their header (.nrrd), or in files that the header names (.nhdr)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from . import detached, packed
from .sample_grid import Samples, count_of, placed

ENDINGS = (".nrrd", ".nhdr")
HEADER = 2**22
"""Largest size of the header, in bytes."""
_LIST = re.compile(rb"^data ?file:\s*LIST[^\n]*\n", re.MULTILINE)
_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "signed short", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}


def read(path: Path) -> Samples:
    """The samples, which may be raw, text, or compressed by gzip.

    Raises ValueError, and the errors of pynrrd.
    """
    raw = packed.content(path)
    header, names, body = _header(raw)
    shape = tuple(int(size) for size in header["sizes"])
    count = count_of(shape)
    layout = np.dtype(
        ("<" if header.get("endian", "little") == "little" else ">") + _TYPES[header["type"]]
    )
    encoding = header["encoding"].lower()
    if encoding not in ("raw", "gzip", "gz", "text", "txt", "ascii"):
        raise ValueError(f"its encoding is {encoding}; save it raw or with gzip")
    text = encoding in ("text", "txt", "ascii")
    size = None if text else count * layout.itemsize
    lines = int(header.get("line skip", header.get("lineskip", 0)))
    skip = int(header.get("byte skip", header.get("byteskip", 0)))
    window = 31 if encoding in ("gzip", "gz") else None
    if names:
        body = detached.read(path, names, size, lines, skip, window)
    else:
        body = detached.part(body, size, lines, skip, window)
    if text:
        flat = np.array(body.split(maxsplit=count)[:count], dtype=np.float64)
    else:
        flat = np.frombuffer(body, layout, count)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    axes: Any = header.get("space directions", header.get("spacings", np.ones(3)))
    axes = np.asarray(axes, dtype=np.float64)
    # Row k is the direction of axis k of the samples.
    steps = np.diag(axes) if axes.shape == (3,) else axes.T
    return placed(flat.reshape(shape, order="F"), origin, steps)


def files_beside(path: Path) -> list[Path]:
    """The files with the data of the header at ``path``, if it can be read and names any.

    Raises OSError, and the errors of ``packed.beginning``.
    """
    import nrrd

    try:
        with np.errstate(all="ignore"):  # ``read`` finds sizes that are not numbers
            names = _header(packed.beginning(path, HEADER))[1]
    except (
        ValueError, KeyError, IndexError, TypeError, OverflowError, StopIteration, nrrd.NRRDError,
    ):  # fmt: skip
        return []
    return [path.parent / name for name in names]


def _header(raw: bytes) -> tuple[Any, list[str], bytes]:
    """The fields of a header, the names of its data files if there are any,
    and the bytes after it."""
    import nrrd

    ends = [(at, mark) for mark in (b"\n\n", b"\r\n\r\n") if (at := raw.find(mark)) >= 0]
    at, mark = min(ends, default=(len(raw), b""))
    head, body = raw[:at], raw[at + len(mark) :]
    if len(head) > HEADER:
        raise ValueError("its header has no end")
    head = head.replace(b"\r", b"") + b"\n"
    listed = _LIST.search(head)
    names: list[str] = []
    if listed:
        names = head[listed.end() :].decode("utf-8", errors="replace").split("\n")
        names = [name.strip() for name in names if name.strip()]
        if not names:
            raise ValueError("its LIST has no names of files")
        head = head[: listed.start()]
    header: Any = nrrd.read_header(iter((head + b"\n").splitlines(True)))
    place = str(header.get("data file", header.get("datafile", "")))
    words = place.split()
    if "%" in place and len(words) in (4, 5):
        names = detached.numbered(words[0], *(int(word) for word in words[1:4]))
    elif place:
        names = [place]
    elif not listed and not mark:
        raise ValueError("it has no data after its header, and names no file with data")
    return header, names, body
