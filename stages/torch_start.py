"""torch made ready before its threads take turns."""

from __future__ import annotations

from functools import cache

FUNCTIONS = (
    "acos", "asin", "atan", "cos", "cosh", "erf", "exp", "expm1", "log", "log10", "log1p", "log2",
    "sin", "sinh", "sqrt", "tan", "tanh",
)  # fmt: skip


def start(threads: int) -> None:
    """Let torch use ``threads``, each function of its vector library having been called once, and
    of its operations only those that give the same bits every time, where it has them."""
    import torch

    torch.set_num_threads(threads)
    # What CUDA has no such operation for is said; on a processor there is none of these.
    torch.use_deterministic_algorithms(True, warn_only=torch.cuda.is_available())
    # All that is read has been written before, so that filling it first is time lost.
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
