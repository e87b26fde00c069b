"""Reading NumPy's own files, which may be anything, without trusting them."""

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
"""Numbers in a file."""
DAMAGED = (
    OSError, ValueError, EOFError, MemoryError, SyntaxError, KeyError, OverflowError, TypeError,
    NotImplementedError, RuntimeError, TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What NumPy raises at damaged files."""


@contextmanager
def _unwarned() -> Iterator[None]:
    """NumPy warns of the headers that it then refuses, or reads all the same."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def single_array(path: Path) -> NDArray[Any]:
    """The array of a .npy file, not yet read unless it is packed. Raises InputError."""
    try:
        with _unwarned():
            # What is packed has no place in a file that could be mapped.
            mode: Any = None if packed.is_packed(path) else "r"
            values: NDArray[Any] = np.load(_opened(path), mmap_mode=mode, allow_pickle=False)
    except DAMAGED as error:
        raise _unreadable(path, error) from error
    _check(path, values)
    return values


def named_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file. Raises InputError."""
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
    """Of the arrays in a .npz file, without reading them; none of a file that is damaged."""
    try:
        with zipfile.ZipFile(_opened(path)) as archive:
            return [Path(name).stem for name in archive.namelist()]
    except (OSError, ValueError, InputError, zipfile.BadZipFile):
        return []


def dimensions(path: Path) -> int:
    """Of the array in a .npy file; 0 if it is damaged."""
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
