"""HDF5 files that somebody made to do harm, and their manifests made to fit.

An attack changes one file of a run; ``attack`` then gives the manifest its new digest and its
checksums, so that only what the file holds can give it away.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from damages import sealed

from vorolight.schemas import layouts

Attack = Callable[[h5py.File, str], None]


def _replaced(file: h5py.File, name: str, **options: Any) -> h5py.Dataset:
    """An array created anew, with its own values if nothing else is said."""
    values = file[name][()]
    del file[name]
    if not {"data", "shape"} & options.keys():
        options["data"] = values
    return file.create_dataset(name, **options)


def _linked(file: h5py.File, name: str, link: Any) -> None:
    del file[name]
    file[name] = link


def _elsewhere(file: h5py.File, name: str) -> None:
    shape = file[name].shape or (1,)
    count = 8 * int(np.prod(shape))
    _replaced(file, name, shape=shape, dtype="f8", external=[("/dev/zero", 0, count)])


def _virtual(file: h5py.File, name: str) -> None:
    shape = file[name].shape or (1,)
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource("classify.h5", "origin", shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


def _vast(file: h5py.File, name: str, rows: int = 10**12) -> None:
    """Chunks that are not there are read as the fill value, however many."""
    shape = (rows, *file[name].shape[1:])
    chunks = (1000, *shape[1:])
    _replaced(file, name, shape=shape, dtype=file[name].dtype, chunks=chunks, fillvalue=0)


def _bomb(file: h5py.File, name: str) -> None:
    """Eight gigabytes of zeros, packed to eight megabytes."""
    shape = file[name].shape[1:]
    width = int(np.prod(shape)) * 8
    rows = 64_000_000 // width
    made = _replaced(
        file, name, shape=(125 * rows, *shape), dtype="f8", chunks=(rows, *shape),
        compression="gzip",
    )  # fmt: skip
    packed = zlib.compress(bytes(rows * width), 9)
    for row in range(125):
        made.id.write_direct_chunk((row * rows, *(0 for _ in shape)), packed)


def _unknown_filter(file: h5py.File, name: str) -> None:
    values = file[name][()]
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk(values.shape)
    plan.set_filter(32_001, h5py.h5z.FLAG_OPTIONAL, (0, 0, 0, 0))
    space = h5py.h5s.create_simple(values.shape)
    del file[name]
    h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(values.dtype), space, plan)
    file[name][...] = values


def _nested(file: h5py.File, name: str) -> None:
    place = file.create_group("deep")
    for _ in range(3000):
        place = place.create_group("a")


GENERIC: dict[str, Attack] = {
    "soft link": lambda file, name: _linked(file, name, h5py.SoftLink("/spacing")),
    "dangling link": lambda file, name: _linked(file, name, h5py.SoftLink("/nowhere")),
    "link to itself": lambda file, name: _linked(file, name, h5py.SoftLink("/" + name)),
    "external link": lambda file, name: _linked(
        file, name, h5py.ExternalLink("classify.h5", "/origin")
    ),
    "external link to a pipe": lambda file, name: _linked(
        file, name, h5py.ExternalLink("pipe", "/origin")
    ),
    "external storage": _elsewhere,
    "virtual": _virtual,
    "unknown filter": _unknown_filter,
    "lzf": lambda file, name: void(_replaced(file, name, compression="lzf")),
    "scale-offset": lambda file, name: void(_replaced(file, name, scaleoffset=4)),
    "strings": lambda file, name: void(
        _replaced(file, name, shape=file[name].shape, dtype=h5py.string_dtype())
    ),
    "references": lambda file, name: void(
        _replaced(file, name, shape=file[name].shape, dtype=h5py.ref_dtype)
    ),
    "lists": lambda file, name: void(
        _replaced(file, name, shape=file[name].shape, dtype=h5py.vlen_dtype(np.dtype("f8")))
    ),
    "compound": lambda file, name: void(
        _replaced(file, name, shape=file[name].shape, dtype=[("a", "f8"), ("b", "i4")])
    ),
    "arrays in cells": lambda file, name: void(
        _replaced(file, name, shape=file[name].shape[:1], dtype=np.dtype(("f8", (3,))))
    ),
    "complex": lambda file, name: void(_replaced(file, name, data=file[name][()] * 1j)),
    "long double": lambda file, name: void(_replaced(file, name, dtype=np.longdouble)),
    "no values": lambda file, name: void(_replaced(file, name, data=h5py.Empty(np.dtype("f8")))),
    "a group": lambda file, name: void(_linked(file, name, file.create_group("b"))),
    "vast": _vast,
    "vast beyond 64 bits": partial(_vast, rows=2**62),
    "bomb": _bomb,
    "large attribute": lambda file, name: file.attrs.create("stage", np.zeros(8000)),
    "attribute of strings": lambda file, name: file.attrs.create("stage", ["a" * 100] * 50),
    "deep groups": _nested,
    "group in itself": lambda file, name: _linked_in(file.create_group("loop")),
}


def void(_: object) -> None:
    """Nothing; for attacks that are an expression."""


def _linked_in(group: h5py.Group) -> None:
    group["again"] = group


def _put(file: h5py.File, name: str, value: float) -> None:
    values = file[name][()]
    if np.ndim(values) == 0:
        values = np.array(value, values.dtype)
    else:
        values.reshape(-1)[values.size // 2] = value
    _replaced(file, name, data=values)


def _index(file: h5py.File, name: str, low: bool) -> None:
    values = file[name][()]
    # One less than the least that there is; or one that no array is long enough for.
    _put(file, name, min(int(values.min()), 0) - 1 if low else 2**31 - 1)


def of_arrays(stem: str) -> dict[str, tuple[str, Attack]]:
    """Attacks on each array of a stage's file by their names, with the array that they change."""
    found: dict[str, tuple[str, Attack]] = {}
    for name, layout in layouts.LAYOUTS[stage_of(stem)].items():
        changes: dict[str, Attack] = {
            "row gone": lambda file, name: void(_replaced(file, name, data=file[name][1:])),
            "empty": lambda file, name: void(_replaced(file, name, data=file[name][:0])),
            "one more dimension": lambda file, name: void(
                _replaced(file, name, data=file[name][()][None])
            ),
        }
        if not layout.shape:
            changes = {}
        if layout.kind == "i":
            changes["index too low"] = partial(_index, low=True)
            changes["index too high"] = partial(_index, low=False)
            changes["floats"] = lambda file, name: void(_replaced(file, name, dtype="f8"))
        elif layout.kind == "f":
            changes["not a number"] = partial(_put, value=np.nan)
            changes["infinite"] = partial(_put, value=-np.inf)
            changes["huge"] = partial(_put, value=1e300)
            changes["integers"] = lambda file, name: void(_replaced(file, name, dtype="i4"))
            if "spacing" in name or "radi" in name:
                changes["negative"] = partial(_put, value=-1.0)
                changes["zero"] = partial(_put, value=0.0)
        else:
            changes["floats"] = lambda file, name: void(_replaced(file, name, dtype="f8"))
        changes["gone"] = _delete
        found |= {f"{name} {what}": (name, change) for what, change in changes.items()}
    return found


def _delete(file: h5py.File, name: str) -> None:
    del file[name]


def stage_of(stem: str) -> str:
    return "evaluate" if stem.startswith("evaluate") else stem


def all_of(path: Path) -> dict[str, tuple[str, Attack]]:
    """All attacks on a file: the generic ones on one of its arrays of numbers."""
    stem = path.stem
    with h5py.File(path) as file:
        layout = layouts.LAYOUTS[stage_of(stem)]
        target = next(
            name for name, one in layout.items() if one.kind == "f" and file[name].ndim == 2
        ) if stem != "classify" else "origin"  # fmt: skip
        arrays = {k: v for k, v in of_arrays(stem).items() if v[0] in file}
    return {name: (target, change) for name, change in GENERIC.items()} | arrays


def attack(path: Path, name: str) -> None:
    """Change the file and let its manifest fit. Raises what h5py raises where it cannot be made."""
    target, change = all_of(path)[name]
    with h5py.File(path, "r+") as file:
        change(file, target)
    refit(path)


def refit(path: Path) -> None:
    """Give the manifest of a file its size, digest and time, and then its own checksums."""
    manifest = path.with_suffix(".json")
    record = json.loads(manifest.read_bytes())
    data = path.read_bytes()
    for entry in record["outputs"]:
        if entry["path"] == path.name:
            entry.update(bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    record["volatile"]["mtime_ns"][path.name] = path.stat().st_mtime_ns
    manifest.write_bytes(sealed(record))
