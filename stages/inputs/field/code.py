"""Functions in a Python module of the user's, fields among them; run only when that is allowed."""

from __future__ import annotations

import importlib
import re
import sys
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ...errors import InputError, UsageError

_NAME = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):([A-Za-z_]\w*)")


def is_code(text: str) -> bool:
    """Whether ``text`` is ``module:function``."""
    return _NAME.fullmatch(text) is not None


def file_of(text: str, flag: str = "--field") -> Path:
    """The file of the module in ``module:function``; nothing is imported to find it.

    Raises InputError when there is none in the current folder nor where Python looks; ``flag`` is
    the option that it was given with.
    """
    module = text.partition(":")[0]
    places: Any = [str(Path.cwd()), *sys.path]
    spec = None
    for part in module.split("."):
        spec = PathFinder.find_spec(part, places) if places else None
        places = spec.submodule_search_locations if spec else None
    if spec is None or spec.origin is None:
        raise InputError(
            f"{flag} {text}: there is no module {module} in this folder or on Python's path"
        )
    return Path(spec.origin)


@dataclass(frozen=True)
class CodeField:
    """The field ``module:function``: called with arrays x, y and z and their namespace, numpy or
    torch."""

    name: str
    function: Any

    def __call__(self, x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
        try:
            value = self.function(x, y, z, xp)
        # The user's code may raise anything.
        except Exception as error:
            raise InputError(
                f"--field {self.name}: fails on arrays of {xp.__name__} ({type(error).__name__}: "
                f"{str(error)[:100]}); it is called with x, y, z and numpy or torch"
            ) from error
        if getattr(value, "shape", None) != x.shape:
            raise InputError(f"--field {self.name}: does not return a number for each point")
        return value


def imported(text: str, allowed: bool, flag: str) -> Any:
    """The function of ``module:function``, which is imported.

    Raises UsageError unless code is ``allowed``, InputError when there is none.
    """
    place = file_of(text, flag)
    if not allowed:
        raise UsageError(
            f"{flag} {text}: runs the Python code in {place}; add --allow-code if you trust it"
        )
    module, _, function = text.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), function, None)
    # So may its import.
    except Exception as error:
        raise InputError(
            f"{flag} {text}: {place} fails ({type(error).__name__}: {error})"
        ) from error
    finally:
        sys.path.remove(here)
    if not callable(found):
        raise InputError(f"{flag} {text}: {place} has no function {function}")
    return found


def load(text: str, allowed: bool) -> CodeField:
    """The field of ``module:function``, which is imported and tried.

    Raises UsageError unless code is ``allowed``, InputError when it cannot be used.
    """
    field = CodeField(text, imported(text, allowed, "--field"))
    import torch

    at = np.linspace(-1, 1, 4)
    field(at, at, at, np)
    field(torch.tensor(at), torch.tensor(at), torch.tensor(at), torch)
    return field
