"""VTI: samples on a grid, as image data of VTK."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from . import packed
from .sample_grid import Samples, count_of, placed

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip


def read(path: Path) -> Samples:
    """The first scalars at the points of VTK image data, in any of its encodings.

    Raises ValueError, and the errors of the parsers of XML and zlib.
    """
    raw = packed.content(path)
    text, mark, appended = raw.partition(b"<AppendedData")
    encoding = ""
    if mark:
        attributes, _, appended = appended.partition(b">")
        encoding = "base64" if b"base64" in attributes else "raw"
        appended = appended[appended.index(b"_") + 1 :]
        text += b"</VTKFile>"
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise ValueError("it defines entities")
    root = ElementTree.fromstring(text)
    image = root.find("ImageData")
    if root.get("type") != "ImageData" or image is None:
        raise ValueError("it holds no ImageData")
    pieces = image.findall("Piece")
    arrays = pieces[0].findall("PointData/DataArray") if pieces else []
    scalars = [one for one in arrays if one.get("NumberOfComponents", "1") == "1"]
    if len(pieces) != 1 or not scalars:
        raise ValueError("it has no scalars at its points, or several pieces")
    names = {one.get("Name"): one for one in scalars}
    data = pieces[0].find("PointData")
    wanted = data.get("Scalars") if data is not None else None
    array = names.get(wanted, scalars[0])
    first, last = np.array(pieces[0].attrib["Extent"].split(), dtype=np.int64).reshape(3, 2).T
    shape = tuple(int(size) for size in last - first + 1)
    count = count_of(shape)
    step = np.array(image.get("Spacing", "1 1 1").split(), dtype=np.float64)
    origin = np.array(image.get("Origin", "0 0 0").split(), dtype=np.float64)
    turned = np.array(image.get("Direction", "1 0 0 0 1 0 0 0 1").split(), dtype=np.float64)
    steps = turned.reshape(3, 3) * step
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    kind = np.dtype(order + _TYPES[array.attrib["type"]])
    header = np.dtype(order + _TYPES[root.get("header_type", "UInt32")])
    compressed = root.get("compressor")
    if compressed not in (None, "vtkZLibDataCompressor"):
        raise ValueError(f"it is compressed by {compressed}; use zlib or none")
    if array.get("format") == "ascii":
        flat = np.array((array.text or "").split(), dtype=np.float64)[:count]
    else:
        if array.get("format") == "appended":
            if not mark:
                raise ValueError("its appended data are missing")
            source, coded = appended[int(array.attrib["offset"]) :], encoding == "base64"
        else:
            source, coded = (array.text or "").strip().encode(), True
        flat = np.frombuffer(_bytes(source, coded, header, compressed, count * kind.itemsize),
                             kind, count)  # fmt: skip
    values = flat.reshape(shape, order="F")
    return placed(values, origin + steps @ first, steps)


def _bytes(
    source: bytes, coded: bool, header: np.dtype[Any], compressed: str | None, most: int
) -> bytes:
    """The bytes of a data array. They follow their number or, if compressed, the
    sizes of their blocks."""

    def take(start: int, size: int) -> tuple[bytes, int]:
        """``size`` bytes from position ``start`` of the source, and the position after them."""
        if not coded:
            return source[start : start + size], start + size
        end = start + 4 * -(-size // 3)
        return base64.b64decode(source[start:end])[:size], end

    width = header.itemsize
    if compressed is None:
        # In base64 the number and the bytes are encoded together.
        size = int(np.frombuffer(take(0, width)[0], header)[0])
        return take(0, width + min(size, most))[0][width:]
    blocks, usual, rest = (int(n) for n in np.frombuffer(take(0, 3 * width)[0], header))
    if blocks * width > len(source) or (blocks and usual * (blocks - 1) + rest > most + usual):
        raise ValueError("its blocks do not fit its grid")
    sizes, at = take(0, (3 + blocks) * width)
    found, total = [], 0
    lengths = np.frombuffer(sizes, header)[3:].astype(np.int64)
    body = take(at, int(lengths.sum()))[0]
    for length in lengths:
        block = zlib.decompressobj().decompress(body[total : total + length], max(usual, rest))
        found.append(block)
        total += int(length)
    return b"".join(found)
