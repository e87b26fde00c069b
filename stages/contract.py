"""What a stage is: its parameters, its parents, its outputs and ``run(context)``."""

from __future__ import annotations

import ast
import dataclasses
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, get_args, get_origin
from typing import get_type_hints as _type_hints

from .errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from .artifacts.checkpoints import Checkpoints
    from .artifacts.hdf5 import Arrays
    from .artifacts.run_folder import RunFolder
    from .sources.protocol import Source
    from .sources.true_surface import TrueSurface


MAX_FACES = 400_000
"""Triangles that a surface may need, unless more are asked for."""


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


class Params:
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


def options(params: type[Params]) -> tuple[Option, ...]:
    """The options of a Params dataclass, read from its annotations and field docstrings."""
    if params not in _OPTIONS:
        _OPTIONS[params] = _read_options(params)
    return _OPTIONS[params]


_OPTIONS: dict[type[Params], tuple[Option, ...]] = {}


def _read_options(params: type[Params]) -> tuple[Option, ...]:
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


def params_schema(params: type[Params]) -> dict[str, Any]:
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


class Progress(Protocol):
    """Receives the progress of a stage."""

    def start(self, label: str, total: int) -> None: ...

    def advance(self, done: int, note: str = "") -> None: ...

    def finish(self) -> None: ...

    def note(self, text: str) -> None: ...

    def detail(self, text: str) -> None: ...


class Silent:
    """Progress that is not shown."""

    def start(self, label: str, total: int) -> None:
        pass

    def advance(self, done: int, note: str = "") -> None:
        pass

    def finish(self) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def detail(self, text: str) -> None:
        pass


@dataclass(frozen=True)
class Context:
    """Everything that a stage receives: parameters, results of earlier stages, input, and where to
    report."""

    params: Any
    folder: RunFolder
    source: Callable[[], Source]
    """Opens the input. The result of a stage that never calls it does not depend on the input
    file."""
    seed: int
    threads: int
    device: str
    progress: Progress
    checkpoints: Checkpoints
    random: Callable[..., np.random.Generator]
    """``random(purpose, counter)`` gives a generator of counter-based random numbers for this
    stage."""

    @cached_property
    def surface(self) -> TrueSurface:
        """The input's true surface in model units."""
        from .sources.true_surface import true_surface
        from .surface.model_frame import ModelFrame

        return true_surface(self.source(), ModelFrame.of(self.arrays("classify")), self.threads)

    def arrays(self, stage: str) -> Arrays:
        """The arrays that an earlier stage wrote."""
        return self.folder.arrays(stage, stage)


@dataclass(frozen=True)
class Outcome:
    """The result of a stage: arrays for its HDF5 file, other files by suffix, and its figures."""

    arrays: dict[str, Any]
    files: dict[str, bytes] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    recheck: Callable[[dict[str, Path]], dict[str, Any]] | None = None
    """Called with the written files by suffix; what it returns becomes ``metrics.as_written``."""
    frame: dict[str, Any] | None = None
    """Unit, 4 x 4 matrix to the input's coordinates, and bounding box; None if these are the
    input's."""


def _no_parents(params: Any) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """A stage: one module, one Params, one ``run``."""

    name: str
    version: int
    """Raised by hand whenever results of existing inputs change."""
    params: type[Params]
    run: Callable[[Context], Outcome]
    memory: Callable[[Context], float]
    """The expected peak memory in MB."""
    parents: Callable[[Any], tuple[str, ...]] = _no_parents
    """The stages whose files it reads, given its parameters."""
    reads_input: bool = False
    """Whether the result also depends on the input directly, not only through its parents."""
    stem: Callable[[Any], str] | None = None
    """File name of its results if that is not the stage's name."""
    extra_inputs: Callable[[Any], dict[str, str]] = lambda params: {}
    """Further inputs by role: files or names of built-in fields."""

    def stem_of(self, params: Any) -> str:
        return self.stem(params) if self.stem else self.name
