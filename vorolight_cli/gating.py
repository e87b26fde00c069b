"""What ``evaluate`` can be told to insist on: its gates, and thresholds of the user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vorolight.stages.errors import GateFailure

if TYPE_CHECKING:
    from vorolight.stages.artifacts.run_folder import RunFolder
    from vorolight.stages.metrics.requirements import Requirement


@dataclass(frozen=True)
class Gating:
    """Whether all gates must hold, and what figures must be."""

    strict: bool
    requirements: list[Requirement]

    def check(self, folder: RunFolder, stem: str) -> None:
        """Raise GateFailure for what the evaluation ``stem`` found not to be so, and UsageError
        for requirements on figures that it does not have."""
        from vorolight.stages.metrics.gates import failed

        metrics: dict[str, Any] = (folder.manifest(stem) or {})["metrics"]
        faults = [item.fault(metrics) for item in self.requirements]
        faults += failed(metrics).values() if self.strict else []
        said = [fault for fault in faults if fault is not None]
        if not said:
            return
        marked = folder.file(stem, "defects.ply")
        where = f"; all of them are in {marked}" if self.strict and marked.is_file() else ""
        raise GateFailure(f"{folder.path}: {metrics['of']}: {'; '.join(said)}{where}")


def gating(
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Exit with 5 unless the surface is closed, manifold, oriented, free of "
            "self-intersections, of the reference's topology, and certified if that was claimed.",
        ),
    ] = False,
    require: Annotated[
        list[str] | None,
        typer.Option(
            "--require",
            help='Exit with 5 unless a figure is so: "f1>=0.98", "euler_number==2". May be given '
            "several times.",
            show_default=False,
        ),
    ] = None,
) -> Gating:
    from vorolight.stages.metrics.requirements import Requirement

    return Gating(strict, [Requirement.parse(text) for text in require or []])
