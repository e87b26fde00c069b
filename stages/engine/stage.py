"""What a stage is: its parameters, its parents, its outputs and ``run(context)``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from ..artifacts.checkpoints import Checkpoints
    from ..artifacts.hdf5 import Arrays
    from ..artifacts.run_folder import RunFolder
    from ..inputs.source import Source
    from ..mesh.queries.true_surface import TrueSurface
    from ..progress import Progress
    from .params import StageParams


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
        from ..mesh.model_frame import ModelFrame

        return self.source().true_surface(ModelFrame.of(self.arrays("classify")), self.threads)

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
    params: type[StageParams]
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
