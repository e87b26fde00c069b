"""Points in a text file: finds which columns are coordinates and normals."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np

from ..mesh.polygons import Floats

LOOKED_AT = 200
"""Number of rows from which the separator and the numeric columns are determined."""
UNIT, UNIT_SHARE = 0.05, 0.9
"""Largest deviation of a normal's length from 1, and the share of rows for which it must hold."""
OTHER_SCALE = 1000.0
"""A column without a name is not a coordinate if it is so many times as large as both others."""
SHOWN = 60
"""Number of characters of a row that a message shows."""
MARKS = ("#", "//")
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?$")
UNITS = re.compile(r"[\[(].*?[\])]")
AXES = tuple(
    {axis, f"p{axis}", f"{axis}_coord", f"{axis}coord", f"{axis}_m"}
    | {
        f"{word}{mark}{axis}"
        for word in ("pos", "position", "point", "coord")
        for mark in ("", "_")
    }
    | {f"points:{number}", f"points_{number}", f"position:{number}", other}
    for number, (axis, other) in enumerate(
        zip("xyz", ("easting", "northing", "elevation"), strict=True)
    )
)
NORMALS = tuple(
    {f"n{axis}", f"n_{axis}", f"normal{axis}", f"normal_{axis}"}
    | {f"normals:{number}", f"normals_{number}", f"normal:{number}"}
    for number, axis in enumerate("xyz")
)
"""Names of the columns of coordinates and of normals."""


@dataclass(frozen=True)
class Table:
    """Points ``(N, 3)``, normals if there are any, and a note about the columns that were taken."""

    points: Floats
    normals: Floats | None
    note: str = ""
    columns: tuple[int, ...] = ()
    """The columns that were taken, counted from 1."""


@dataclass(frozen=True)
class _Layout:
    """How the rows of a file are divided into columns."""

    delimiter: str | None
    """The separator of columns; None for blanks."""
    decimal_comma: bool
    columns: int
    names: tuple[str, ...]
    """The names of the columns, if the file has them."""
    numeric: tuple[int, ...]
    """The columns that hold numbers."""

    def fields(self, line: str) -> list[str]:
        if self.decimal_comma:
            line = line.replace(",", ".")
        return [field.strip().strip("\"'").strip() for field in line.split(self.delimiter)]


def read(raw: bytes, columns: str | None = None) -> Table:
    """The points in the text ``raw``.

    ``columns`` has the names or numbers, from 1, of the columns of x, y, z and possibly of the
    normal. Without it they are found by name, or else by position. Raises ValueError with the line
    and the fault.
    """
    lines = text_of(raw).splitlines()
    kept: list[tuple[int, str]] = []
    heads: list[str] = []
    for number, line in enumerate(lines, 1):
        bare = line.strip()
        if any(bare.startswith(mark) for mark in MARKS):
            if not kept:
                heads.append(bare.lstrip("#/").strip())
            continue
        for mark in MARKS:
            bare = bare.partition(mark)[0].rstrip()
        if bare:
            kept.append((number, bare))
    kept = _without_counts(kept)
    begin, layout = _layout([line for _, line in kept], heads)
    rows = kept[begin:]
    found, note = _chosen(layout, columns), ""
    table = _numbers(rows, layout, found)
    if columns is None and not layout.names:
        note = _plausible(table, layout, found)
        if len(layout.numeric) == 6 and found == layout.numeric[:3]:
            both = _numbers(rows, layout, layout.numeric)
            if are_normals(both[:, 3:]):
                found, table, note = layout.numeric, both, ""
    normals = table[:, 3:] if len(found) == 6 else None
    return Table(table[:, :3], normals, note, tuple(k + 1 for k in found))


def are_normals(vectors: Floats) -> bool:
    """Whether ``vectors (N, 3)`` are unit vectors. After coordinates, columns
    are as often colours."""
    length = np.linalg.norm(vectors, axis=1)
    return len(length) > 0 and bool((np.abs(length - 1) < UNIT).mean() > UNIT_SHARE)


def text_of(raw: bytes) -> str:
    for mark, coding in (
        (b"\xff\xfe", "utf-16"),
        (b"\xfe\xff", "utf-16"),
        (b"\xef\xbb\xbf", "utf-8-sig"),
    ):
        if raw.startswith(mark):
            return raw.decode(coding, errors="replace")
    if b"\0" in raw:
        # In UTF-16, every second byte of an ASCII character is zero.
        for first, coding in ((1, "utf-16-le"), (0, "utf-16-be")):
            if not any(raw[first::2]):
                return raw.decode(coding, errors="replace")
        raise ValueError("it is not a text file")
    return raw.decode("utf-8", errors="replace")


def _without_counts(rows: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """The rows without those lines of a PTS that say how many points its next cloud has."""
    counts = [k for k, (_, line) in enumerate(rows) if line.isascii() and line.isdigit()]
    if all(int(rows[k][1]) == end - k - 1 for k, end in pairwise([*counts, len(rows)])):
        left_out = set(counts)
        return [row for k, row in enumerate(rows) if k not in left_out]
    return rows


def _layout(lines: list[str], heads: list[str]) -> tuple[int, _Layout]:
    """The index of the first row among ``lines``, and the layout. ``heads``
    are comments above it."""
    sample = list(islice(reversed(lines), LOOKED_AT))
    for delimiter, comma in _ways(sample):
        way = _Layout(delimiter, comma, 0, (), ())
        begin = next(
            (k for k, line in enumerate(lines) if sum(map(_is_number, way.fields(line))) >= 3), None
        )
        if begin is None:
            continue
        looked = [way.fields(line) for line in lines[begin : begin + LOOKED_AT]]
        count = min(len(fields) for fields in looked if sum(map(_is_number, fields)) >= 3)
        numeric = tuple(
            k
            for k in range(count)
            if all(_is_number(fields[k]) for fields in looked if len(fields) >= count)
        )
        if len(numeric) < 3:
            continue
        names: tuple[str, ...] = ()
        for number, head in enumerate([*heads, *lines[:begin]]):
            fields = tuple(UNITS.sub("", field).strip().lower() for field in way.fields(head))
            words = not all(map(_is_number, filter(None, fields)))
            # A comment may be any sentence, so that it need not have names of columns.
            if number < len(heads):
                words = min(_named(fields)[:3]) >= 0
            if len(fields) >= count and words:
                names = fields
        return begin, _Layout(delimiter, comma, count, names, numeric)
    raise ValueError("it has no row of three numbers")


def _ways(sample: list[str]) -> list[tuple[str | None, bool]]:
    """The possible separators of the rows in ``sample``, and whether commas are decimal points.

    The most likely one comes first.
    """
    text = "\n".join(sample)
    words = [word for line in sample for word in line.split()]
    commas = [word for word in words if DECIMAL_COMMA.match(word)]
    found: list[tuple[str | None, bool]] = []
    for mark in (";", "\t"):
        if mark in text:
            found.append((mark, "," in text and "." not in text))
    numbers = all(DECIMAL_COMMA.match(word) or _is_number(word) for word in words)
    if commas and numbers and all(len(line.split()) >= 3 for line in sample):
        found.append((None, True))
    return [*found, (",", False), (None, False)]


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _chosen(layout: _Layout, columns: str | None) -> tuple[int, ...]:
    """The columns of the coordinates and, if there are any, of the normals."""
    if columns is not None:
        wanted = [name.strip().lower() for name in columns.split(",")]
        if len(wanted) not in (3, 6):
            raise ValueError(f"--columns {columns}: name three columns, or six with the normals")
        found = []
        for name in wanted:
            if name in layout.names:
                found.append(layout.names.index(name))
            elif name.isdigit() and 1 <= int(name) <= layout.columns:
                found.append(int(name) - 1)
            else:
                raise ValueError(
                    f"--columns {columns}: it has no column {name}, but {layout.columns} columns"
                    + (f": {', '.join(layout.names)}" if layout.names else "")
                )
        return tuple(found)
    named = _named(layout.names)
    if min(named[:3]) >= 0:
        return tuple(named if min(named) >= 0 else named[:3])
    if len(layout.numeric) == 3:
        return layout.numeric
    if layout.names:
        raise ValueError(
            f"its columns are called {', '.join(name or 'nothing' for name in layout.names)}; say "
            "which are x, y and z, as in --columns 2,3,4"
        )
    return layout.numeric[:3]


def _named(names: tuple[str, ...]) -> list[int]:
    """The columns with the names of x, y, z and of the normal; -1 for a name that is missing."""
    return [
        next((k for k, name in enumerate(names) if name in axis), -1) for axis in AXES + NORMALS
    ]


def _plausible(table: Floats, layout: _Layout, found: tuple[int, ...]) -> str:
    """A note about columns that were chosen by position. Raises ValueError if
    they are not coordinates."""
    if len(layout.numeric) == 3:
        return ""
    other = "say which are x, y and z, as in --columns 2,3,4"
    finite = table[np.isfinite(table).all(axis=1)]
    size = np.abs(finite).max(axis=0, initial=0.0)
    for k, column in enumerate(finite.T):
        step = np.diff(column)
        if len(step) and step[0] != 0 and (step == step[0]).all():
            raise ValueError(f"its column {found[k] + 1} only counts the rows; {other}")
        if size[k] > OTHER_SCALE * np.delete(size, k).max():
            raise ValueError(
                f"the numbers in its column {found[k] + 1} are more than "
                f"{OTHER_SCALE:g} times those in the other two, so they may be times; "
                f"{other}"
            )
    taken = ", ".join(str(k + 1) for k in found[:2]) + f" and {found[2] + 1}"
    return f"columns {taken} of {layout.columns} are taken for x, y and z; --columns takes others"


def _numbers(rows: list[tuple[int, str]], layout: _Layout, columns: tuple[int, ...]) -> Floats:
    """The values of these columns in all rows, ``(N, len(columns))``."""
    lines = [line.replace(",", ".") for _, line in rows] if layout.decimal_comma else [
        line for _, line in rows
    ]  # fmt: skip
    try:
        return np.loadtxt(
            lines,
            delimiter=layout.delimiter,
            usecols=columns,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
    except ValueError:
        for number, line in rows:
            fields = layout.fields(line)
            if not all(k < len(fields) and _is_number(fields[k]) for k in columns):
                names = ", ".join(str(k + 1) for k in columns)
                raise ValueError(
                    f"line {number} has no numbers in columns {names}: {line[:SHOWN]}"
                ) from None
        raise
