"""Reads samples on a grid. The suffix of the file decides the format."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..errors import InputError
from . import metaimage, nifti, nrrd_file, packed, vti_file
from .arrays_file import named_arrays, single_array
from .sample_grid import Samples

READERS: dict[str, Callable[[Path], Samples]] = {
    **dict.fromkeys(nrrd_file.ENDINGS, nrrd_file.read),
    **dict.fromkeys(metaimage.ENDINGS, metaimage.read),
    ".nii": nifti.read,
    ".vti": vti_file.read,
}
"""The readers of formats that contain only samples on a grid, by suffix."""


def read(path: Path) -> Samples:
    """The samples in ``path``, unchanged. Raises InputError if they cannot be read."""
    suffix = packed.ending(path)
    try:
        if suffix == ".npy":
            return Samples(single_array(path), np.zeros(3), np.ones(3))
        if suffix == ".npz":
            return _npz(path)
        if suffix not in READERS:
            raise ValueError(f"samples on a grid end with .npy, .npz, {', '.join(READERS)}")
        with np.errstate(all="ignore"):
            return READERS[suffix](path)
    except (
        OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError,
        StopIteration, zlib.error, ElementTree.ParseError, _nrrd_error(),
    ) as error:  # fmt: skip
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable {suffix[1:].upper()} ({reason[:100]})") from error


def files_beside(path: Path) -> list[Path]:
    """The files with the samples whose header is ``path``; none if the samples are in the same
    file.

    Raises OSError and InputError if the header cannot be read.
    """
    suffix = packed.ending(path)
    if suffix in nrrd_file.ENDINGS:
        return nrrd_file.files_beside(path)
    return metaimage.files_beside(path) if suffix in metaimage.ENDINGS else []


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
