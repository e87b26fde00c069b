"""Reads files of NumPy (.npy, .npz), which may be damaged or harmful,
without executing anything."""

from __future__ import annotations

import io
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import packed

LARGEST = 512**3
"""Largest number of values in a file."""
DAMAGED = (
    OSError, ValueError, EOFError, MemoryError, SyntaxError, KeyError, OverflowError, TypeError,
    NotImplementedError, RuntimeError, TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""The exceptions that NumPy raises for damaged files."""


@contextmanager
def _unwarned() -> Iterator[None]:
    """Suppress NumPy's warnings about headers, which it then refuses or reads correctly."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def single_array(path: Path) -> NDArray[Any]:
    """The array of a .npy file, which is mapped into memory unless the file is packed.

    Raises InputError if it cannot be read, holds no numbers, or is too large.
    """
    try:
        with _unwarned():
            # A packed array cannot be mapped into memory.
            mode: Any = None if packed.is_packed(path) else "r"
            values: NDArray[Any] = np.load(_opened(path), mmap_mode=mode, allow_pickle=False)
    except DAMAGED as error:
        raise _unreadable(path, error) from error
    _check(path, values)
    return values


def named_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name.

    Raises InputError if it cannot be read, holds no numbers, or is too large.
    """
    try:
        with zipfile.ZipFile(_opened(path)) as archive:
            size = sum(item.file_size for item in archive.infolist())
        if size > 8 * LARGEST + 100_000:
            raise ValueError(f"{size / 1e9:.1f} GB of numbers are too many; reduce them")
        with _unwarned(), np.load(_opened(path), allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
    except DAMAGED as error:
        raise _unreadable(path, error) from error
    for values in arrays.values():
        _check(path, values)
    return arrays


def names(path: Path) -> list[str]:
    """The names of the arrays in a .npz file, which are not read; none if it is damaged."""
    try:
        with zipfile.ZipFile(_opened(path)) as archive:
            return [Path(name).stem for name in archive.namelist()]
    except (OSError, ValueError, InputError, zipfile.BadZipFile):
        return []


def dimensions(path: Path) -> int:
    """The number of dimensions of the array in a .npy file; 0 if it is damaged."""
    try:
        return single_array(path).ndim
    except InputError:
        return 0


def _opened(path: Path) -> Path | io.BytesIO:
    return io.BytesIO(packed.content(path)) if packed.is_packed(path) else path


def _unreadable(path: Path, error: Exception) -> InputError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return InputError(f"{path}: not a readable array file ({reason[:100]})")


def _check(path: Path, values: NDArray[Any]) -> None:
    if values.dtype.kind not in "fiub":
        raise InputError(f"{path}: has values of type {values.dtype}, not numbers")
    if values.size > LARGEST:
        raise InputError(f"{path}: {values.size} numbers are more than {LARGEST}; reduce them")
