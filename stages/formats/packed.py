"""Files that are packed by gzip, which are treated as the file inside."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from ..errors import InputError

PACKED = ".gz"
MOST = 2**30 + 2**20
"""Largest size of a packed file's content in bytes: 512^3 numbers of eight bytes, and a header."""


def is_packed(path: Path) -> bool:
    """Whether the name of ``path`` ends in .gz."""
    return path.suffix.lower() == PACKED


def ending(path: Path) -> str:
    """The suffix of the content in lower case: .ply for ball.ply and for ball.ply.gz."""
    return (Path(path.stem) if is_packed(path) else path).suffix.lower()


def stem(path: Path) -> str:
    """The name of the content without its suffix: ball for ball.ply and for ball.ply.gz."""
    return Path(path.stem).stem if is_packed(path) else path.stem


def content(path: Path) -> bytes:
    """The bytes of a file, unpacked if it is packed.

    Raises OSError if it cannot be read, and InputError if it is a damaged gzip file or holds more
    than MOST bytes.
    """
    if not is_packed(path):
        return path.read_bytes()
    raw = _unpacked(path, MOST + 1)
    if len(raw) > MOST:
        raise InputError(
            f"{path}: holds more than {MOST / 1e9:.1f} GB when it is unpacked; thin out what is in "
            "it, or unpack it and give the file that was in it"
        )
    return raw


def beginning(path: Path, count: int) -> bytes:
    """The first ``count`` bytes of ``content``, or all if there are fewer.
    Raises the same errors."""
    if is_packed(path):
        return _unpacked(path, count)
    with path.open("rb") as file:
        return file.read(count)


def _unpacked(path: Path, count: int) -> bytes:
    try:
        with gzip.open(path) as file:
            return file.read(count)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise InputError(f"{path}: is damaged or no gzip file ({error}); pack it again") from error
