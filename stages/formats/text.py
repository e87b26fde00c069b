"""Numbers as lines of text, with all digits."""

from __future__ import annotations

from itertools import pairwise

from ..mesh.polygons import Floats, Ints


def rows(values: Floats | Ints, between: str = " ") -> str:
    """One line for each row of ``values (N, K)``."""
    return "\n".join(between.join(map(repr, row)) for row in values.tolist())


def lists(offsets: Ints, values: Ints, between: str = " ", closing: str = "") -> str:
    """One line for each slice ``values[offsets[i]:offsets[i + 1]]``: its
    length, then its members."""
    words = list(map(str, values.tolist()))
    return "\n".join(
        f"{end - start}{between}{' '.join(words[start:end])}{closing}"
        for start, end in pairwise(offsets.tolist())
    )
