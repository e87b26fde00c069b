"""Compile loops to machine code with numba.

Import this module only where such loops are, since numba takes 90 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(function: Kernel) -> Kernel:
    """``function`` as machine code, cached on disk if a folder can be written.

    It releases the interpreter's lock, so that threads can run it at the same time.
    """
    made: Any
    try:
        made = numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # neither the package folder nor the user's cache can be written
        made = numba.njit(nogil=True)(function)
    return cast(Kernel, made)
