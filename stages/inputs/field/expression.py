"""Formulas of x, y and z as a user writes them, checked and never handed to an interpreter."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ...errors import InputError
from ...mesh.polygons import Floats

Formula = Callable[[Any, Any, Any, ModuleType], Any]
Value = Callable[[Mapping[str, Any]], Any]

CHARACTERS, DEPTH = 4000, 200
"""The longest formula, and how deep it may be nested."""
EXPONENT = 32.0
"""The largest exponent."""
CONSTANTS = {"pi": math.pi, "e": math.e}
ONE = ("sqrt", "abs", "exp", "log", "sin", "cos", "tan", "tanh")
"""Functions of one argument, named alike in numpy and torch."""
MANY = {"min": "minimum", "max": "maximum"}
OPERATIONS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
}

GRID = 32
SIZES = range(-24, 25)
"""A shape is looked for in cubes about the origin whose half-edges are these powers of two."""
BEYOND = 4
"""Doublings of the cube in which no more of the shape turns up, before that is taken for all."""


def parse(text: str) -> Formula:
    """The formula ``text``, for numpy arrays and for torch tensors (with exact gradients).

    Raises InputError for anything but numbers, x, y, z, pi, e, + - * / **, and the functions sqrt,
    abs, exp, log, sin, cos, tan, tanh, min and max.
    """
    if len(text) > CHARACTERS:
        raise InputError(f"the formula has {len(text)} characters; {CHARACTERS} are the most")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else type(error).__name__
        raise InputError(f"{_short(text)}: is not a formula ({reason})") from error
    if not any(isinstance(node, ast.Name) and node.id in "xyz" for node in _walk(tree, text)):
        raise InputError(f"{_short(text)}: contains none of x, y and z")
    value = _Compiler(text).compile(tree)

    def formula(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
        with np.errstate(all="ignore"):
            return value({"x": x, "y": y, "z": z, "xp": xp})

    return formula


def looks_like_one(text: str) -> bool:
    """Whether ``text`` is a formula rather than the name of something that is not there."""
    try:
        parse(text)
    except InputError:
        return False
    return not text.strip().isidentifier()


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


def _walk(tree: ast.AST, text: str) -> list[ast.AST]:
    """All nodes; refuses a tree that is too deep to be gone through by recursion."""
    level, found = [tree], []
    for _ in range(DEPTH):
        found += level
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if not level:
            return found
    raise InputError(f"{_short(text)}: is nested deeper than {DEPTH} levels; simplify it")


class _Compiler:
    def __init__(self, text: str) -> None:
        self.text = text

    def compile(self, node: ast.AST) -> Value:
        """What ``node`` is worth, given x, y, z and the module to compute with."""
        number = node.value if isinstance(node, ast.Constant) else None
        if isinstance(number, int | float) and not isinstance(number, bool):
            return self._constant(number)
        if isinstance(node, ast.Name) and node.id in CONSTANTS:
            return self._constant(CONSTANTS[node.id])
        if isinstance(node, ast.Name) and node.id in ("x", "y", "z"):
            name = node.id
            return lambda at: at[name]
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            inner, sign = self.compile(node.operand), -1.0 if isinstance(node.op, ast.USub) else 1.0
            return lambda at: sign * inner(at)
        if isinstance(node, ast.BinOp):
            return self._operation(node)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._call(node.func.id, [self.compile(part) for part in node.args])
        raise self._refusal(node)

    def _refusal(self, node: ast.AST) -> InputError:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor):
            return InputError(f"{_short(self.text)}: write powers as a**b, not a^b")
        part = ast.get_source_segment(self.text.strip(), node) or type(node).__name__
        allowed = ", ".join((*ONE, *MANY))
        return InputError(
            f"{_short(self.text)}: '{_short(part)}' is not allowed in a formula; use numbers, x, "
            f"y, z, pi, e, + - * / ** and {allowed}"
        )

    def _constant(self, number: float) -> Value:
        try:
            value = float(number)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise InputError(f"{_short(self.text)}: has a number that is too large")
        return lambda at: at["xp"].asarray(value, dtype=at["xp"].float64)

    def _operation(self, node: ast.BinOp) -> Value:
        left = self.compile(node.left)
        if isinstance(node.op, ast.Pow):
            power = self._number(node.right)
            return lambda at: left(at) ** power
        if type(node.op) not in OPERATIONS:
            raise self._refusal(node)
        apply, right = OPERATIONS[type(node.op)], self.compile(node.right)
        return lambda at: apply(left(at), right(at))

    def _number(self, node: ast.AST) -> float:
        """An exponent: a formula without x, y and z, and not too large."""
        names = [item.id for item in ast.walk(node) if isinstance(item, ast.Name)]
        if not set(names) & {"x", "y", "z"}:
            with np.errstate(all="ignore"):
                value = float(self.compile(node)({"xp": np}))
            if abs(value) <= EXPONENT:
                return value
        raise InputError(
            f"{_short(self.text)}: exponents are numbers from -{EXPONENT:g} to {EXPONENT:g}"
        )

    def _call(self, name: str, arguments: list[Value]) -> Value:
        if name in ONE and len(arguments) == 1:
            (argument,) = arguments
            return lambda at: getattr(at["xp"], name)(argument(at))
        if name in MANY and len(arguments) > 1:

            def fold(at: Mapping[str, Any]) -> Any:
                result = arguments[0](at)
                for argument in arguments[1:]:
                    result = getattr(at["xp"], MANY[name])(result, argument(at))
                return result

            return fold
        known = name in ONE or name in MANY
        raise InputError(
            f"{_short(self.text)}: {name} takes {'one argument' if name in ONE else 'two or more'}"
            if known
            else f"{_short(self.text)}: there is no function {name}; use {', '.join((*ONE, *MANY))}"
        )


def search_box(value: Callable[[Floats], Floats], text: str) -> Floats:
    """A box ``(2, 3)`` about all that is negative, with room around it.

    It is looked for on grids of cubes of growing size; what is smaller than a cell of the cube that
    holds all of it may be missed. Raises InputError when the field is nowhere negative, negative
    without end, or not a number somewhere.
    """
    found, clear = None, 0
    for size in SIZES:
        half = 2.0**size
        part = _negative(value, np.array([[-half] * 3, [half] * 3]))
        if part is not None and part.endless:
            found, clear = None, 0
        elif part is not None and (found is None or not part.within(found)):
            found, clear = part.box, 0
        elif found is not None:
            clear += 1
        if clear == BEYOND:
            break
    if found is None:
        raise InputError(
            f"{_short(text)}: no bounded inside was found; the field must be negative inside, "
            "positive around it, and not far from the origin (negate it, or cut it off: "
            "max(..., x**2 + y**2 + z**2 - 9))"
        )
    # Once more, finer.
    tight = _negative(value, found)
    box = found if tight is None else tight.box
    if not np.isfinite(value(_grid(box))).all():
        raise InputError(
            f"{_short(text)}: is not a finite number everywhere in the box of the "
            "shape; keep arguments of sqrt and log positive, and divisors away from "
            "zero"
        )
    return box


def _grid(box: Floats) -> Floats:
    steps = (np.arange(GRID) + 0.5) / GRID
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(box[0] + unit * (box[1] - box[0]))


@dataclass(frozen=True)
class _Part:
    """What is negative in a box, as far as a grid tells: the points' own box, that with two cells
    around it, and whether it goes on beyond."""

    points: Floats
    box: Floats
    endless: bool

    def within(self, box: Floats) -> bool:
        return bool((self.points[0] >= box[0]).all() and (self.points[1] <= box[1]).all())


def _negative(value: Callable[[Floats], Floats], box: Floats) -> _Part | None:
    grid = _grid(box)
    below = value(grid) < 0
    if not below.any():
        return None
    points = np.stack([grid[below].min(axis=0), grid[below].max(axis=0)])
    cell = (box[1] - box[0]) / GRID
    endless = bool((points[0] < box[0] + cell).any() or (points[1] > box[1] - cell).any())
    return _Part(points, points + np.array([[-2.5], [2.5]]) * cell, endless)
