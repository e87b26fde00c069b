"""Bounds that a user sets on the metrics of an evaluation, such as ``f1>=0.98``."""

from __future__ import annotations

import difflib
import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import UsageError

OPERATORS = {
    ">=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne,
    ">": operator.gt, "<": operator.lt,
}  # fmt: skip
FORM = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(>=|<=|==|!=|>|<)\s*(\S+)\s*")
OF_REFERENCE = ("expected_", "reference_")
WORDS = {"true": True, "false": False}


@dataclass(frozen=True)
class Requirement:
    """A metric, a relation and a value."""

    name: str
    relation: str
    value: float | bool

    @classmethod
    def parse(cls, text: str) -> Requirement:
        """The requirement in ``text``, such as ``f1>=0.98``. Raises UsageError
        if it has another form."""
        match = FORM.fullmatch(text)
        if match is None:
            raise UsageError(
                f'--require "{text}": is not of the form "f1>=0.98" (>=, <=, >, <, == or !=)'
            )
        name, relation, value = match.groups()
        if value.lower() in WORDS:
            return cls(name, relation, WORDS[value.lower()])
        try:
            return cls(name, relation, float(value))
        except ValueError:
            raise UsageError(
                f'--require "{text}": {value} is neither a number nor true or false'
            ) from None

    def fault(self, metrics: Mapping[str, Any]) -> str | None:
        """A sentence that says why ``metrics`` do not meet the requirement, or None if they do.

        The name is that of a metric, or the end of its path: ``f1`` or ``chamfer.f1``. If several
        metrics have it, the least nested one is meant. Raises UsageError if none has it, or several
        on one level.
        """
        figures = dict(_figures(metrics))
        ends = [path for path in figures if f".{path}".endswith(f".{self.name}")]
        depth = min((path.count(".") for path in ends), default=0)
        ends = [path for path in ends if path.count(".") == depth]
        if not ends:
            last = {path.rpartition(".")[2] for path in figures}
            near = difflib.get_close_matches(self.name.rpartition(".")[2], last, n=3)
            raise UsageError(
                f"--require {self.name}: no such figure; "
                + (f"there is {', '.join(near)}" if near else "evaluate --json prints all of them")
            )
        if len(ends) > 1:
            raise UsageError(f"--require {self.name}: name one of {', '.join(sorted(ends))}")
        found = figures[ends[0]]
        if found is None:
            return f"{ends[0]} is not known, but {self.relation} {self.value:g} is required"
        if OPERATORS[self.relation](found, self.value):
            return None
        shown = found if isinstance(found, bool) else f"{found:.6g}"
        return f"{ends[0]} is {shown}, but {self.relation} {self.value:g} is required"


def _figures(metrics: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of all metrics of the surface that can be compared with a number.

    A sentence replaces the value of a metric that is not known.
    """
    for key, value in metrics.items():
        if key.startswith(OF_REFERENCE):
            continue
        if isinstance(value, Mapping):
            yield from _figures(value, f"{prefix}{key}.")
        elif value is None or isinstance(value, (bool, int, float)):
            yield prefix + key, value
        elif isinstance(value, str):
            yield prefix + key, None
