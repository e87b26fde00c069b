"""Reading samples on a grid: NPY, NPZ, NRRD and VTI."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.polygons import Floats
from .arrays_file import LARGEST, named_arrays, single_array

_NRRD_TYPES = {
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
_VTK_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Samples:
    """``values (A, B, C)``; sample ``(i, j, k)`` is at ``origin + spacing * (i, j, k)``."""

    values: NDArray[Any]
    origin: Floats
    spacing: Floats


def read(path: Path) -> Samples:
    """The samples in ``path``, as they are. Raises InputError when they cannot be read."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy":
            return Samples(single_array(path), np.zeros(3), np.ones(3))
        if suffix == ".npz":
            return _npz(path)
        with np.errstate(all="ignore"):
            found = _nrrd(path.read_bytes()) if suffix == ".nrrd" else _vti(path.read_bytes())
    except (
        OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError,
        StopIteration, zlib.error, ElementTree.ParseError, _nrrd_error(),
    ) as error:  # fmt: skip
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable {suffix[1:].upper()} ({reason[:100]})") from error
    if not (np.isfinite(found.origin).all() and (found.spacing > 0).all()):
        raise InputError(f"{path}: its origin is not finite or its spacing not positive")
    return found


def _nrrd_error() -> type[Exception]:
    import nrrd

    error: type[Exception] = nrrd.NRRDError
    return error


def _npz(path: Path) -> Samples:
    found = named_arrays(path)
    if "values" not in found:
        raise InputError(f"{path}: has no array called 'values'; save the samples under this name")
    origin = np.asarray(found.get("origin", np.zeros(3)), dtype=np.float64)
    spacing = np.asarray(found.get("spacing", np.ones(3)), dtype=np.float64)
    if origin.shape != (3,) or spacing.shape not in ((), (1,), (3,)):
        raise InputError(f"{path}: 'origin' is three numbers, 'spacing' one or three")
    spacing = np.broadcast_to(spacing, 3).astype(np.float64)
    if not (np.isfinite(origin).all() and np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InputError(f"{path}: 'origin' must be finite and 'spacing' positive")
    return Samples(found["values"], origin, spacing)


def _nrrd(raw: bytes) -> Samples:
    """An NRRD with its data attached: raw, text or gzip, axes along x, y and z."""
    import nrrd

    head, mark, body = raw.partition(b"\n\n")
    if not mark:
        head, mark, body = raw.partition(b"\r\n\r\n")
    header: Any = nrrd.read_header(iter((head.replace(b"\r", b"") + b"\n\n").splitlines(True)))
    if {"data file", "datafile"} & set(header):
        raise ValueError("its data are in another file; save header and data in one file")
    shape = tuple(int(size) for size in header["sizes"])
    layout = np.dtype(("<" if header.get("endian", "little") == "little" else ">")
                      + _NRRD_TYPES[header["type"]])  # fmt: skip
    count = _count(shape)
    encoding = header["encoding"].lower()
    if encoding in ("gzip", "gz"):
        body = zlib.decompressobj(31).decompress(body, count * layout.itemsize)
    if encoding in ("text", "txt", "ascii"):
        flat = np.array(body.split(maxsplit=count)[:count], dtype=np.float64)
    elif encoding in ("raw", "gzip", "gz"):
        flat = np.frombuffer(body, layout, count)
    else:
        raise ValueError(f"its encoding is {encoding}; save it raw or with gzip")
    values = flat.reshape(shape, order="F")
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    axes: Any = header.get("space directions", header.get("spacings", np.ones(3)))
    axes = np.asarray(axes, dtype=np.float64)
    if axes.shape == (3, 3) and values.ndim == 3:
        # Row k is the direction of the samples' axis k, along x, y or z.
        along = np.abs(axes).argmax(axis=1)
        steps = axes[np.arange(3), along]
        if np.count_nonzero(axes) != 3 or len(set(along.tolist())) < 3:
            raise ValueError("its axes are not those of space; resample it along x, y and z")
        order = np.argsort(along)
        values, axes = values.transpose(order), steps[order]
    if origin.shape != (3,) or axes.shape != (3,) or values.ndim != 3:
        raise ValueError("it is not a three-dimensional grid")
    return _upward(values, origin, axes)


def _upward(values: NDArray[Any], origin: Floats, step: Floats) -> Samples:
    """With the axes that run downward turned."""
    for axis in np.flatnonzero(step < 0):
        values = np.flip(values, int(axis))
        origin = origin + np.eye(3)[axis] * step * (values.shape[axis] - 1)
    return Samples(values, origin, np.abs(step))


def _vti(raw: bytes) -> Samples:
    """The first scalars at the points of VTK image data, in whatever encoding."""
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
        raise ValueError("it has no ImageData")
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
    count = _count(shape)
    step = np.array(image.get("Spacing", "1 1 1").split(), dtype=np.float64)
    origin = np.array(image.get("Origin", "0 0 0").split(), dtype=np.float64)
    turned = np.array(image.get("Direction", "1 0 0 0 1 0 0 0 1").split(), dtype=np.float64)
    if not np.array_equal(turned, np.eye(3).ravel()):
        raise ValueError("its axes are not those of space; resample it along x, y and z")
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    kind = np.dtype(order + _VTK_TYPES[array.attrib["type"]])
    header = np.dtype(order + _VTK_TYPES[root.get("header_type", "UInt32")])
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
        flat = np.frombuffer(_vtk_bytes(source, coded, header, compressed, count * kind.itemsize),
                             kind, count)  # fmt: skip
    values = flat.reshape(shape, order="F")
    return _upward(values, origin + first * step, step)


def _vtk_bytes(
    source: bytes, coded: bool, header: np.dtype[Any], compressed: str | None, most: int
) -> bytes:
    """The bytes of a data array: after their number, or as compressed blocks after their sizes."""

    def take(start: int, size: int) -> tuple[bytes, int]:
        """``size`` bytes from position ``start`` of the source, and the position after them."""
        if not coded:
            return source[start : start + size], start + size
        end = start + 4 * -(-size // 3)
        return base64.b64decode(source[start:end])[:size], end

    width = header.itemsize
    if compressed is None:
        # The number and the bytes are one string of base64.
        size = int(np.frombuffer(take(0, width)[0], header)[0])
        return take(0, width + min(size, most))[0][width:]
    blocks, usual, rest = (int(n) for n in np.frombuffer(take(0, 3 * width)[0], header))
    if blocks * width > len(source) or (blocks and usual * (blocks - 1) + rest > most + usual):
        raise ValueError("its blocks do not fit its grid")
    sizes, at = take(0, (3 + blocks) * width)
    found, total = [], 0
    lengths = np.frombuffer(sizes, header)[3:].astype(np.int64)
    packed = take(at, int(lengths.sum()))[0]
    for length in lengths:
        block = zlib.decompressobj().decompress(packed[total : total + length], max(usual, rest))
        found.append(block)
        total += int(length)
    return b"".join(found)


def _count(shape: tuple[int, ...]) -> int:
    """Of samples. Raises ValueError for impossible shapes."""
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"its samples have shape {shape}")
    count = int(np.prod(np.array(shape, dtype=object)))
    if count > LARGEST:
        raise ValueError(f"{count} samples are more than {LARGEST}; reduce them")
    return count
