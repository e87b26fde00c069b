"""Files of the dual graph: CSV, HDF5, PFLOTRAN's explicit grid, and the MESH of TOUGH.

Cells are numbered from 0 in CSV and HDF5, and from 1 for PFLOTRAN. For TOUGH they have names.
"""

from __future__ import annotations

import string

import numpy as np

from ..artifacts import hdf5
from ..errors import InputError
from ..mesh.dual_graph import DualGraph
from ..mesh.polygons import Floats, Ints
from .text import rows

LETTERS = string.ascii_uppercase + string.digits
MOST = 26 * 36 * 36 * 100
"""The number of names that TOUGH has for elements: a letter, two letters or digits, a number."""
WIDTH = 10
"""Number of characters of a value in the MESH of TOUGH."""
LEAST = 1e-99
"""Smaller values are written as 0 there."""


def csv(graph: DualGraph) -> dict[str, bytes]:
    """``cells.csv``, ``connections.csv`` and ``boundary.csv``, with a line of names first."""
    inner = graph.inner
    return {
        "cells.csv": _table(
            "cell,x,y,z,volume", np.arange(len(graph.volume)), graph.points, graph.volume
        ),
        "connections.csv": _table(
            "cell,other,area,distance,other_distance,x,y,z,normal_x,normal_y,normal_z",
            graph.cells[:inner], graph.area[:inner], graph.distance[:inner],
            graph.centre[:inner], graph.normal[:inner],
        ),
        "boundary.csv": _table(
            "cell,area,distance,x,y,z,normal_x,normal_y,normal_z",
            graph.cells[inner:, 0], graph.area[inner:], graph.distance[inner:, 0],
            graph.foot[inner:], graph.normal[inner:],
        ),
    }  # fmt: skip


def encode_hdf5(graph: DualGraph) -> bytes:
    """The arrays of the graph by their names in ``DualGraph``."""
    names = ("points", "volume", "cells", "normal", "area", "distance", "foot", "centre", "tilt")
    return hdf5.encode(None, {name: getattr(graph, name) for name in names}, {})


def pflotran(graph: DualGraph) -> dict[str, bytes]:
    """``mesh.uge``, and ``surface.ex`` with the connections of the boundary for a region.

    The point of a connection is where the line between the generators meets the face. PFLOTRAN
    takes distances from it, so that both are right.
    """
    inner, count = graph.inner, len(graph.volume)
    cells = _columns(np.arange(1, count + 1), graph.points, graph.volume)
    pairs = _columns(graph.cells[:inner] + 1, graph.foot[:inner], graph.area[:inner])
    walls = _columns(graph.cells[inner:, 0] + 1, graph.foot[inner:], graph.area[inner:])
    return {
        "mesh.uge": f"CELLS {count}\n{cells}\nCONNECTIONS {inner}\n{pairs}\n".encode(),
        "surface.ex": f"CONNECTIONS {len(graph.cells) - inner}\n{walls}\n".encode(),
    }


def tough(graph: DualGraph) -> dict[str, bytes]:
    """The file ``MESH``, with blocks ELEME and CONNE.

    Each face of the boundary has an element without volume, which TOUGH keeps at its first state.
    They come last, because TOUGH takes all elements after the first of them as inactive. Gravity
    is against z. A value has ten characters, and so five to eight digits. Raises InputError if
    there are more elements than names.
    """
    inner, count = graph.inner, len(graph.volume)
    walls = len(graph.cells) - inner
    if count + walls > MOST:
        raise InputError(
            f"the cells and boundary faces are {count + walls}, but TOUGH has names for {MOST} "
            "elements; lower -n or --inner"
        )
    names = _names(count + walls)
    place = np.concatenate([graph.points, graph.foot[inner:]])
    volume = np.concatenate([graph.volume, np.zeros(walls)])
    rocks = ["SOLID"] * count + ["BOUND"] * walls
    values = [_fixed(column) for column in (volume, *place.T)]
    elements = [
        f"{name}          {rock}{size}{'':20}{x}{y}{z}"
        for name, rock, size, x, y, z in zip(names, rocks, *values, strict=True)
    ]
    cells = graph.cells.copy()
    cells[inner:, 1] = np.arange(count, count + walls)
    columns = (*graph.distance.T, graph.area, -graph.normal[:, 2])
    connections = [
        f"{names[one]}{names[other]}{'':15}    1{here}{there}{area}{slope}"
        for one, other, here, there, area, slope in zip(
            *cells.T.tolist(), *map(_fixed, columns), strict=True
        )
    ]
    blocks = ("ELEME", elements), ("CONNE", connections)
    text = "".join(f"{word}\n{chr(10).join(lines)}\n\n" for word, lines in blocks)
    return {"MESH": text.encode()}


def _names(count: int) -> list[str]:
    """Names of ``count`` elements, of five characters each."""
    prefixes = [a + b + c for a in LETTERS[:26] for b in LETTERS for c in LETTERS]
    return [f"{prefixes[i // 100]}{i % 100:02d}" for i in range(count)]


def _fixed(values: Floats) -> list[str]:
    """Numbers of WIDTH characters each, with as many digits as fit."""

    def text(value: float) -> str:
        short = f"{value:{WIDTH}.{3 if value < 0 else 4}e}"
        whole = len(str(int(abs(value)))) + (value < 0)
        if whole + 2 > WIDTH:
            return short
        plain = f"{value:.{WIDTH - 1 - whole}f}"[:WIDTH]
        nearer = abs(float(plain) - value) <= abs(float(short) - value)
        return plain if nearer else short

    # The exponents of smaller values have three digits.
    return [text(value) for value in np.where(np.abs(values) < LEAST, 0.0, values).tolist()]


def _table(names: str, *columns: Floats | Ints) -> bytes:
    return f"{names}\n{_columns(*columns, between=',')}\n".encode()


def _columns(*columns: Floats | Ints, between: str = " ") -> str:
    """Lines of several arrays ``(N,)`` or ``(N, K)`` side by side."""
    parts = [rows(values.reshape(len(values), -1), between).split("\n") for values in columns]
    return "\n".join(map(between.join, zip(*parts, strict=True)))
