"""Files packed by gzip: what they hold, under the name that they have without .gz."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from ..errors import InputError

PACKED = ".gz"
MOST = 2**30 + 2**20
"""Bytes that a packed file may hold: 512^3 numbers of eight bytes, and their header."""


def is_packed(path: Path) -> bool:
    """Whether the file at ``path`` is packed, by its name."""
    return path.suffix.lower() == PACKED


def ending(path: Path) -> str:
    """The ending of the name of what is in a file, in lower case: .ply of ball.ply and of
    ball.ply.gz."""
    return (Path(path.stem) if is_packed(path) else path).suffix.lower()


def stem(path: Path) -> str:
    """The name of what is in a file without its ending: ball of ball.ply and of ball.ply.gz."""
    return Path(path.stem).stem if is_packed(path) else path.stem


def content(path: Path) -> bytes:
    """The bytes of a file, unpacked if it is packed.

    Raises OSError when it cannot be read, InputError when it is no sound gzip file or holds more
    than ``MOST`` bytes.
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
    """The first ``count`` bytes of ``content``, or all of them if there are fewer.

    Raises what ``content`` does.
    """
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
