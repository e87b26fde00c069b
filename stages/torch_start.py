"""Prepare torch before several threads use it."""

from __future__ import annotations

from functools import cache

FUNCTIONS = (
    "acos", "asin", "atan", "cos", "cosh", "erf", "exp", "expm1", "log", "log10", "log1p", "log2",
    "sin", "sinh", "sqrt", "tan", "tanh",
)  # fmt: skip


def start(threads: int) -> None:
    """Let torch use ``threads``, and only operations that give the same bits every time.

    Each function of its vector library is called once first.
    """
    import torch

    torch.set_num_threads(threads)
    # CUDA lacks such a version of some operations, which is a warning; a processor has all of them.
    # torch.use_deterministic_algorithms does the same, but imports torch's compiler, which takes as
    # long as torch.
    torch.set_deterministic_debug_mode("warn" if torch.cuda.is_available() else "error")
    # Every value is written before it is read, so filling memory first would waste time.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    settle()


@cache
def settle() -> None:
    """Call each function of the vector library once, by one thread.

    MKL 2024.2 chooses its routines at the first call; where two threads make that at once, one of
    them may compute all its part to ten digits only (pytorch#188792).
    """
    import torch

    for kind in (torch.float32, torch.float64):
        one = torch.full((1,), 0.5, dtype=kind)
        for name in FUNCTIONS:
            getattr(torch, name)(one)
