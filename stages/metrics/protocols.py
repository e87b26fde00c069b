"""The named protocols: frame, number of samples and threshold of F1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Protocol:
    """A way to measure Chamfer distance and F1. Lengths are in ``frame``."""

    name: str
    source: str
    samples: int
    threshold: float
    frame: str = "bounding-box diagonal of the reference = 1"

    def changed(self, samples: int | None, threshold: float | None) -> dict[str, Any]:
        """The entry for the manifest. It names the settings that differ from the protocol."""
        given = {"samples": samples, "threshold": threshold}
        return {
            "name": self.name,
            "source": self.source,
            "samples": samples or self.samples,
            "threshold": threshold or self.threshold,
            "frame": self.frame,
            "changed": [
                key
                for key, value in given.items()
                if value is not None and value != getattr(self, key)
            ],
        }


PROTOCOLS = {
    "vorolight": Protocol("vorolight", "VoroLight, appendix B", 50_000, 0.01),
    "voromesh": Protocol("voromesh", "VoroMesh's own evaluation", 100_000, 0.003),
}
