"""PCD: point clouds of the Point Cloud Library."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..mesh.polygons import Floats
from . import packed, text_table
from .text_table import Table


def read(path: Path) -> Table:
    """The points and, if there are any, their normals, from text or binary data.

    Compressed data are not supported. Raises ValueError and KeyError for damaged files.
    """
    raw = packed.content(path)
    fields: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in fields:
        end = raw.index(b"\n", at)
        words = raw[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            fields[words[0].upper()] = words[1:]
    names = [name.lower() for name in fields["FIELDS"]]
    if fields["DATA"][:1] == ["ascii"]:
        return text_table.read(" ".join(names).encode() + b"\n" + raw[at:])
    if fields["DATA"][:1] != ["binary"]:
        raise ValueError(f"its data are {' '.join(fields['DATA'])}; save them as binary or ascii")
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(names))]
    if not set(fields["SIZE"]) <= set("1248"):
        raise ValueError(f"its fields have sizes {' '.join(fields['SIZE'])}, not 1, 2, 4 or 8")
    kinds = {"F": "f", "I": "i", "U": "u"}
    if ("F", "1") in zip(fields["TYPE"], fields["SIZE"], strict=True):
        raise ValueError("it has floating-point numbers of one byte")
    layout = np.dtype(
        [
            (f"{name} {k}", f"<{kinds[kind]}{int(size)}", (count,))
            for k, (name, kind, size, count) in enumerate(
                zip(names, fields["TYPE"], fields["SIZE"], counts, strict=True)
            )
        ]
    )
    rows = np.frombuffer(raw, layout, int(fields["POINTS"][0]), at)

    def vectors(wanted: tuple[str, ...]) -> Floats | None:
        if not set(wanted) <= set(names):
            return None
        columns = [rows[f"{name} {names.index(name)}"][:, 0] for name in wanted]
        return np.stack(columns, axis=1).astype(np.float64)

    points = vectors(("x", "y", "z"))
    if points is None:
        raise ValueError("it has no fields x, y and z")
    return Table(points, vectors(("normal_x", "normal_y", "normal_z")))
