"""The run folder, with all results of one shape."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import ArtifactError, UsageError
from . import manifest
from .fingerprint import of_bytes

if TYPE_CHECKING:
    from .checkpoints import Checkpoints
    from .hdf5 import Arrays

SUFFIX = ".vorolight"


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run, and all paths in it."""

    path: Path

    @classmethod
    def locate(
        cls, run: Path | None, input_stem: str | None, base: Path | None = None
    ) -> RunFolder:
        """The run folder for the options ``--run`` and INPUT. Its default name comes from the
        input.

        Without both, it is the current folder if that is a run folder, else the only
        ``*.vorolight`` in it. Raises ArtifactError if there is none, and UsageError if there are
        several.
        """
        here = Path() if base is None else base
        if run is not None:
            return cls(run)
        if input_stem is not None:
            return cls(here / f"{input_stem}{SUFFIX}")
        if (here / "classify.json").is_file() or here.resolve().suffix == SUFFIX:
            return cls(here)
        found = sorted(p for p in here.glob(f"*{SUFFIX}") if p.is_dir())
        if len(found) == 1:
            return cls(found[0])
        if not found:
            raise ArtifactError(
                f"no run folder here; give an INPUT, or name one with --run DIR{os.sep}"
            )
        names = ", ".join(p.name for p in found)
        raise UsageError(f"several run folders here ({names}); pick one with --run")

    def file(self, stem: str, suffix: str) -> Path:
        """The data file of a stage, such as ``init.h5``."""
        return self.path / f"{stem}.{suffix}"

    def manifest(self, stem: str) -> manifest.Manifest | None:
        """The manifest of a stage, or None if there is none."""
        path = self.file(stem, "json")
        return manifest.read(path) if path.is_file() else None

    def output(self, stem: str, suffix: str) -> bytes:
        """The bytes of a file of a finished stage, as the stage wrote it.

        Raises ArtifactError if it is missing or was changed.
        """
        path, stored = self.file(stem, suffix), self.manifest(stem)
        if stored is None:
            raise ArtifactError(f"{self.path}: stage {stem} is not done; run: vorolight {stem}")
        sums = [entry["sha256"] for entry in stored["outputs"] if entry["path"] == path.name]
        if not sums:
            raise ArtifactError(f"{path}: not in the manifest of its stage; run it again")
        if not path.exists():
            raise ArtifactError(f"{path}: missing; run: vorolight {stored['stage']}")
        if not manifest.leads_inside(path):
            raise ArtifactError(
                f"{path}: leads out of this folder; delete it and run its stage again"
            )
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ArtifactError(f"{path}: cannot be read ({error.strerror})") from error
        if of_bytes(data) != sums[0]:
            raise ArtifactError(
                f"{path}: changed since it was written; run: vorolight {stored['stage']}"
            )
        return data

    def arrays(self, stem: str, layout: str) -> Arrays:
        """The arrays of a finished stage.

        Raises ArtifactError as ``output`` does, and if the arrays do not have the layout
        ``layout``.
        """
        from .hdf5 import decode

        return decode(self.output(stem, "h5"), self.file(stem, "h5"), layout)[0]

    def checkpoints(
        self, stem: str, fingerprint: str, tell: Callable[..., None] = lambda event, **facts: None
    ) -> Checkpoints:
        """The checkpoints of one run of a stage. ``tell`` is called with every event."""
        from .checkpoints import Checkpoints

        return Checkpoints(self.path / "checkpoints" / stem, fingerprint, tell)
