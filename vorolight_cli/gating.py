"""What ``evaluate`` can require: its gates, and bounds that the user gives."""

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
    """Whether all gates must pass, and the bounds on figures."""

    strict: bool
    requirements: list[Requirement]

    def check(self, folder: RunFolder, stem: str) -> None:
        """Raise GateFailure for gates and bounds that the evaluation ``stem`` does not meet, and
        UsageError for bounds on figures that it does not have."""
        from vorolight.stages.metrics.gates import failed

        metrics: dict[str, Any] = (folder.manifest(stem) or {})["metrics"]
        faults = [item.fault(metrics) for item in self.requirements]
        faults += failed(metrics).values() if self.strict else []
        failures = [fault for fault in faults if fault is not None]
        if not failures:
            return
        marked = folder.file(stem, "defects.ply")
        where = (
            f"; the faulty places are marked in {marked}"
            if self.strict and marked.is_file()
            else ""
        )
        raise GateFailure(f"{folder.path}: {metrics['of']}: {'; '.join(failures)}{where}")


def gating(
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="End with exit code 5 unless the surface is closed, manifold, oriented, free of "
            "self-intersections, of the reference's topology, and certified if it claims to be.",
        ),
    ] = False,
    require: Annotated[
        list[str] | None,
        typer.Option(
            "--require",
            help='End with exit code 5 unless a figure meets a bound, such as "f1>=0.98" or '
            '"euler_number==2". May be given several times.',
            show_default=False,
        ),
    ] = None,
) -> Gating:
    from vorolight.stages.metrics.requirements import Requirement

    return Gating(strict, [Requirement.parse(text) for text in require or []])
