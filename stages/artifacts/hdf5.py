"""HDF5 files whose layout is declared in ``vorolight.schemas.layouts``."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vorolight.schemas import layouts

from .. import memory
from ..errors import ArtifactError

Arrays = dict[str, np.ndarray[Any, Any]]

LARGEST = 4_000_000_000
"""Largest total size of the arrays in a file, unpacked, in bytes."""
MOST, DEEPEST = 1000, 3
"""Largest number of groups and arrays in a file, and of nested groups."""
FILTERS = (1, 2)
"""The filters of HDF5 that are allowed: deflate and shuffle. HDF5 would load others as
libraries of the system."""


def as_array(value: Any) -> np.ndarray[Any, Any]:
    """``value`` as it is returned after reading: a C-ordered array."""
    return np.array(value, order="C")


def encode(stage: str | None, arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> bytes:
    """An HDF5 file of ``arrays``. The same arrays give the same bytes.

    With ``stage`` the arrays are first checked against its layout.
    """
    import h5py

    if stage is not None:
        layouts.check(stage, arrays)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name in sorted(arrays):
            values = np.asarray(arrays[name])
            large = values.ndim > 0 and values.size > 256
            # Shuffle and light compression halve the size for a few milliseconds.
            options = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
            file.create_dataset(name, data=values, **(options if large else {}))
        for name in sorted(attributes):
            file.attrs[name] = attributes[name]
    return buffer.getvalue()


def read(path: Path, stage: str | None) -> tuple[Arrays, dict[str, Any]]:
    """The same as ``decode``, for a file. Raises ArtifactError also if it cannot be read."""
    if not path.is_file():
        raise ArtifactError(f"{path}: missing; run the stage that writes it")
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror})") from error
    return decode(raw, path, stage)


def decode(raw: bytes, path: Path, stage: str | None) -> tuple[Arrays, dict[str, Any]]:
    """The arrays and attributes of an HDF5 file: those of the layout of ``stage``, or all of them.

    Raises ArtifactError, which names ``path``, if they are damaged or have another layout. If they
    would be too large, it is raised before anything is unpacked.
    """
    try:
        arrays, attributes = _unpacked(raw, None if stage is None else layouts.LAYOUTS[stage])
        if stage is not None:
            layouts.check(stage, arrays)
    # h5py may raise almost anything for a file that is not HDF5.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError) as error:
        said = " ".join(str(error).split())[:120]
        raise ArtifactError(
            f"{path}: damaged ({said}); run its stage again with --force"
        ) from error
    return arrays, attributes


def _datasets(file: Any, layout: Mapping[str, Any] | None) -> dict[str, Any]:
    """The arrays of a file by name, without links to other names or files."""
    import h5py

    found: dict[str, Any] = {}
    groups, seen = [("", file)], 0
    while groups:
        prefix, group = groups.pop()
        for key in group:
            seen += 1
            if seen > MOST or prefix.count("/") > DEEPEST:
                raise ValueError("it has more groups or arrays than vorolight writes")
            if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                continue
            item = group[key]
            if isinstance(item, h5py.Group):
                groups.append((f"{prefix}{key}/", item))
            elif isinstance(item, h5py.Dataset) and (layout is None or prefix + key in layout):
                found[prefix + key] = item
    return found


def _unpacked(raw: bytes, layout: Mapping[str, Any] | None) -> tuple[Arrays, dict[str, Any]]:
    import h5py

    with h5py.File(io.BytesIO(raw), "r") as file:
        found = _datasets(file, layout)
        limit, total = min(LARGEST, int(1e6 * memory.free_mb())), 0
        for name, item in found.items():
            if item.dtype.kind not in "biuf" or item.dtype.itemsize > 8:
                raise ValueError(f"array {name} has type {item.dtype}")
            if item.external or item.is_virtual:
                raise ValueError(f"array {name} lies in another file")
            plan = item.id.get_create_plist()
            if any(plan.get_filter(i)[0] not in FILTERS for i in range(plan.get_nfilters())):
                raise ValueError(f"array {name} uses a compression that vorolight does not write")
            total += item.dtype.itemsize * item.size
        if total > limit:
            raise ValueError(f"its arrays would take {total / 1e9:.1f} GB, more than may be read")
        if layout is not None:
            layouts.check_shapes(layout, {name: item.shape for name, item in found.items()})
        attributes = {}
        for name in file.attrs:
            kind = file.attrs.get_id(name)
            if kind.shape != () or kind.get_storage_size() > 4096:
                raise ValueError(f"attribute {name} is not one that vorolight writes")
            attributes[name] = file.attrs[name]
        return {name: item[()] for name, item in found.items()}, attributes
