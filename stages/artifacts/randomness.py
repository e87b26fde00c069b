"""Counter-based random numbers: a generator for (seed, stage, purpose, counter), without any state
to save."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def generator(seed: int, stage: str, purpose: str, counter: int = 0) -> np.random.Generator:
    """A generator; the same four values give the same stream on every machine."""
    import numpy as np

    digest = hashlib.sha256(f"{stage}/{purpose}".encode()).digest()
    words = np.frombuffer(digest[:16], dtype="<u4").tolist()
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, counter, *words])))
