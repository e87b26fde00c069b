"""Random numbers from (seed, stage, purpose, counter), so that no state has to be stored."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def generator(seed: int, stage: str, purpose: str, counter: int = 0) -> np.random.Generator:
    """A random generator. The same four values give the same numbers on every machine."""
    import numpy as np

    digest = hashlib.sha256(f"{stage}/{purpose}".encode()).digest()
    words = np.frombuffer(digest[:16], dtype="<u4").tolist()
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, counter, *words])))
