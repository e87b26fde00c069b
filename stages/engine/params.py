"""The parameters of a stage: one dataclass, from which the command line, the schemas and the
manifests are made."""

from __future__ import annotations

import ast
import dataclasses
import math
import sys
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin
from typing import get_type_hints as _type_hints

from ..errors import UsageError


@dataclass(frozen=True)
class Range:
    """Bounds of a number, both included; None is no bound."""

    low: float | None = None
    high: float | None = None

    def holds(self, value: float) -> bool:
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def __str__(self) -> str:
        if self.high is None:
            return f"at least {_digits(self.low)}"
        return f"from {_digits(self.low)} to {_digits(self.high)}"


def _digits(bound: float | None) -> str:
    return f"{bound:,}" if isinstance(bound, int) else f"{bound:g}"


@dataclass(frozen=True)
class Short:
    """A short flag for an option."""

    flag: str


@dataclass(frozen=True)
class Positional:
    """Marks an option that is given without a flag, before INPUT."""


@dataclass(frozen=True)
class Length:
    """A length in millimetres; as text it may have a unit: 120mm, 12cm, 4.7in."""

    def read(self, text: str) -> float:
        """Millimetres. Raises ValueError unless ``text`` is a number with an optional unit."""
        text = text.strip().lower()
        unit = next((unit for unit in MILLIMETRES if text.endswith(unit)), "")
        return float(text.removesuffix(unit)) * MILLIMETRES.get(unit, 1.0)


MILLIMETRES = {"mm": 1.0, "cm": 10.0, "in": 25.4, "m": 1000.0}
"""Units of a Length; the longer names first."""

Positive = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]


@dataclass(frozen=True)
class Option:
    """One field of a Params dataclass, as the command line, the schemas and the manifests use
    it."""

    name: str
    type: Any
    """The plain type: int, float, bool, str, or a Literal of strings, without None."""
    optional: bool
    default: Any
    meaning: str
    limits: Range | None
    short: str | None
    length: Length | None = None
    positional: bool = False

    def check(self, value: Any) -> Any:
        """``value`` converted to the option's type. Raises UsageError if it does not fit."""
        flag = self.flag
        if value is None and self.optional:
            return None
        if get_origin(self.type) is Literal:
            choices = get_args(self.type)
            if value not in choices:
                raise UsageError(f"{flag} {value}: must be one of {', '.join(choices)}")
            return value
        try:
            if self.type in (int, float) and isinstance(value, bool):
                raise ValueError
            if self.type is int and float(value) != int(value):
                raise ValueError
            if self.type is bool and not isinstance(value, bool):
                raise ValueError
            if self.length is not None and isinstance(value, str):
                value = self.length.read(value)
            converted = self.type(value)
        except (TypeError, ValueError, OverflowError):
            wanted = "a length, such as 1.2mm or 12cm" if self.length else self.type.__name__
            raise UsageError(f"{flag} {value}: must be {wanted}") from None
        if self.type is float and not math.isfinite(converted):
            raise UsageError(f"{flag} {value}: must be a finite number")
        if self.limits is not None and not self.limits.holds(converted):
            raise UsageError(f"{flag} {value}: must be {self.limits}")
        return converted

    @property
    def flag(self) -> str:
        return self.name.upper() if self.positional else "--" + self.name.replace("_", "-")


class StageParams:
    """Base class of the parameters of all stages: a frozen dataclass with a docstring under each
    field."""

    def __post_init__(self) -> None:
        for option in options(type(self)):
            object.__setattr__(self, option.name, option.check(getattr(self, option.name)))

    def as_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)  # type: ignore[call-overload,no-any-return]


@cache
def _module_tree(name: str) -> ast.Module:
    # Not inspect.getsource, which tokenizes the file: that alone makes --help slow.
    return ast.parse(Path(str(sys.modules[name].__file__)).read_text(encoding="utf-8"))


def options(params: type[StageParams]) -> tuple[Option, ...]:
    """The options of a Params dataclass, read from its annotations and field docstrings."""
    if params not in _OPTIONS:
        _OPTIONS[params] = _read_options(params)
    return _OPTIONS[params]


_OPTIONS: dict[type[StageParams], tuple[Option, ...]] = {}


def _read_options(params: type[StageParams]) -> tuple[Option, ...]:
    body = next(
        node.body
        for node in _module_tree(params.__module__).body
        if isinstance(node, ast.ClassDef) and node.name == params.__name__
    )
    meanings: dict[str, str] = {}
    for node, following in pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(following, ast.Expr):
            meanings[ast.unparse(node.target)] = " ".join(
                str(ast.literal_eval(following.value)).split()
            )
    hints = _type_hints(params, include_extras=True)
    found = []
    for item in dataclasses.fields(params):  # type: ignore[arg-type]
        kind: Any = hints[item.name]
        extras: list[Any] = []
        optional = type(None) in get_args(kind)
        if optional:
            kind = next(part for part in get_args(kind) if part is not type(None))
        if get_origin(kind) is Annotated:
            kind, *extras = get_args(kind)
        limits = next((extra for extra in extras if isinstance(extra, Range)), None)
        short = next((extra.flag for extra in extras if isinstance(extra, Short)), None)
        length = next((extra for extra in extras if isinstance(extra, Length)), None)
        positional = any(isinstance(extra, Positional) for extra in extras)
        meaning = meanings[item.name]
        found.append(
            Option(
                item.name, kind, optional, item.default, meaning, limits, short, length, positional
            )
        )
    return tuple(found)


def params_schema(params: type[StageParams]) -> dict[str, Any]:
    """JSON Schema of a stage's parameters, as manifests hold them."""
    names = {int: "integer", float: "number", bool: "boolean", str: "string"}
    properties: dict[str, Any] = {}
    for option in options(params):
        entry: dict[str, Any] = {"description": option.meaning}
        if get_origin(option.type) is Literal:
            entry["enum"] = [*get_args(option.type), *([None] if option.optional else [])]
        else:
            entry["type"] = [names[option.type], "null"] if option.optional else names[option.type]
        if option.limits is not None:
            if option.limits.low is not None:
                entry["minimum"] = option.limits.low
            if option.limits.high is not None:
                entry["maximum"] = option.limits.high
        entry["default"] = option.default
        properties[option.name] = entry
    # No property is required: a manifest from before an option existed is stale, not unreadable.
    return {"type": "object", "properties": properties}
