"""compare.html: several runs side by side, their figures, parameters, times and surfaces."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..artifacts import atomic
from ..artifacts.manifest import Manifest, foreign
from ..artifacts.run_folder import RunFolder
from ..render import image_file
from . import viewer
from .page import STAGES, document, manifests_of, picture, told_to
from .pictures import surfaces, up_of
from .quality import FIGURES, scaled, value_of
from .surfaces import Collected, collect
from .tables import flat, named, shown, table

ABSENT = "not run"
PICTURE = 320


@dataclass(frozen=True)
class Compared:
    """One of the runs, with its name on the page."""

    name: str
    folder: RunFolder
    manifests: Mapping[str, Manifest]
    stale: Mapping[str, str]

    @property
    def shape(self) -> tuple[Any, ...] | None:
        """What identifies the input; None if there is no classify."""
        if "classify" not in self.manifests:
            return None
        entry = self.manifests["classify"]["inputs"][0]
        return entry["kind"], entry["sha256"], entry["name"] if entry["path"] is None else None

    @property
    def of(self) -> str:
        return str(self.manifests["classify"]["inputs"][0]["name"]) if self.shape else "unknown"


def opened(folders: Sequence[RunFolder], stale: Sequence[Mapping[str, str]]) -> list[Compared]:
    """The runs, with names that tell them apart. Raises ArtifactError for a folder that is not a
    run."""
    stems = [folder.path.resolve().stem for folder in folders]
    if len(set(stems)) < len(stems):
        stems = ["/".join(folder.path.resolve().parts[-2:]) for folder in folders]
    names = [
        stem if stems.count(stem) == 1 else f"{stem} ({stems[: k + 1].count(stem)})"
        for k, stem in enumerate(stems)
    ]
    return [
        Compared(name, folder, manifests_of(folder), why)
        for name, folder, why in zip(names, folders, stale, strict=True)
    ]


def difference(runs: Sequence[Compared]) -> str | None:
    """A sentence that says that the runs are of different shapes, or None."""
    if len({run.shape for run in runs}) == 1:
        return None
    inputs = ", ".join(f"{run.name} of {run.of}" for run in runs)
    return f"these runs are of different shapes ({inputs}), so their figures cannot be compared"


def write(runs: Sequence[Compared], target: Path) -> None:
    """Write the page about ``runs``.

    Raises ArtifactError when the file of a finished stage is missing or damaged.
    """
    with foreign(" or ".join(str(run.folder.path) for run in runs)):
        _write(runs, target)


def _write(runs: Sequence[Compared], target: Path) -> None:
    differs = difference(runs)
    collected = [collect(run.folder) for run in runs]
    panels = _panels(runs, collected)
    ups = [up_of(run.folder) for run in runs]
    body = [
        "<header><h1>" + " · ".join(html.escape(run.name) for run in runs) + "</h1>"
        f"<p>{len(runs)} runs side by side</p></header>",
        f'<p class="warn">{html.escape(differs[0].upper() + differs[1:])}.</p>' if differs else "",
        *(_outdated(run) for run in runs),
        viewer.section(panels, ups, differs is None, "The surfaces"),
        _figures(runs, differs is None),
        _parameters(runs),
        _timings(runs),
        _warnings(runs),
        _pictures(runs),
    ]
    title = f"{' and '.join(run.name for run in runs)} - vorolight"
    atomic.write(target, document(title, body).encode("utf-8"))


def _panels(runs: Sequence[Compared], collected: Sequence[Collected]) -> list[viewer.Panel]:
    """The views; each says why a surface that other runs have is missing."""
    stages = {shape.key: shape.stage for found in collected for shape in found.shapes}
    panels = []
    for run, found in zip(runs, collected, strict=True):
        own = {shape.key for shape in found.shapes}
        absent = {
            key: ABSENT if stage not in run.manifests and stage != "input" else "not there"
            for key, stage in stages.items()
            if key not in own
        }
        panels.append(viewer.Panel(run.name, found.shapes, absent))
    return panels


def _head(runs: Sequence[Compared], *more: str) -> tuple[str, ...]:
    return ("", *(html.escape(run.name) for run in runs), *more)


def _outdated(run: Compared) -> str:
    return "".join(
        f'<p class="warn"><b>{html.escape(f"{run.name}: {stage}")} is out of date</b>: '
        f"{html.escape(reason)}</p>"
        for stage, reason in run.stale.items()
    )


def best(values: Sequence[Any], aim: float | None) -> list[bool]:
    """Which of ``values`` are closest to ``aim``; none if all are, or if there is only one."""
    away = [None if value is None or aim is None else abs(value - aim) for value in values]
    known = [distance for distance in away if distance is not None]
    if len(known) < 2 or min(known) == max(known):
        return [False] * len(values)
    return [distance == min(known) for distance in away]


def _figures(runs: Sequence[Compared], comparable: bool) -> str:
    """The evaluations of every stage that one of the runs has evaluated."""
    stems = sorted({stem for run in runs for stem in run.manifests if stem.startswith("evaluate-")})
    if not stems:
        return (
            "<h2>Figures</h2><p>None of the runs was evaluated; "
            "run: <code>vorolight evaluate</code></p>"
        )
    parts = ["<h2>Figures</h2>"]
    for stem in stems:
        found = [run.manifests.get(stem) for run in runs]
        metrics = [None if manifest is None else manifest["metrics"] for manifest in found]
        unlike = _protocols(metrics)
        rows = []
        for key, title, ideal, factor in FIGURES:
            values = [None if m is None else value_of(m, key) for m in metrics]
            if all(value is None for value in values):
                continue
            aim = next((a for m in metrics if m and (a := _aim(m, ideal)) is not None), None)
            # For distances between samples less is better, whatever the sampling floor.
            goal = 0.0 if key == "chamfer.cd2" else aim
            marks = best(values, goal if comparable and not unlike else None)
            cells = [
                (ABSENT if m is None else scaled(value, factor)) + (_MARK if mark else "")
                for m, value, mark in zip(metrics, values, marks, strict=True)
            ]
            label = f'<span title="{key}">{html.escape(title)}</span>'
            rows.append((label, *cells, "" if aim is None else scaled(aim, factor)))
        of = html.escape(stem.removeprefix("evaluate-"))
        parts.append(f"<h3>Of {of}</h3>{table(_head(runs, 'ideal'), rows, 'numbers')}")
        if unlike:
            parts.append(f'<p class="warn">{html.escape(unlike)}</p>')
    rows = [_state(runs, *row) for row in STATES]
    parts.append(f"<h3>Outcomes</h3>{table(_head(runs), rows, 'numbers')}")
    return "".join(parts)


_MARK = ' <b class="good">best</b>'
STATES = (
    ("sphere-train", "certificate.holds", "the certificate holds"),
    ("sphere-train", "conformity.pair_area_share", "share of the area between generator pairs"),
    ("sphere-train", "trained_faces", "trained faces"),
    ("volume", "cells", "cells of the volume"),
    ("fabricate", "printable", "printable"),
)


def _state(runs: Sequence[Compared], stage: str, key: str, title: str) -> tuple[str, ...]:
    cells = [
        html.escape(shown(value_of(run.manifests[stage]["metrics"], key)))
        if stage in run.manifests
        else ABSENT
        for run in runs
    ]
    return (html.escape(title), *cells)


def _aim(metrics: Mapping[str, Any], ideal: Any) -> Any:
    return value_of(metrics, ideal) if isinstance(ideal, str) else ideal


def _protocols(metrics: Sequence[Mapping[str, Any] | None]) -> str:
    """Why these evaluations cannot be compared, or an empty text."""
    for key in ("reference", "samples", "threshold"):
        values = list(dict.fromkeys(m["protocol"].get(key) for m in metrics if m is not None))
        if len(values) > 1:
            said = ", ".join(shown(value) for value in values)
            return f"These were measured with different {key} ({said}), so no best value is marked."
    return ""


def _parameters(runs: Sequence[Compared]) -> str:
    """Parameters that differ between the runs."""
    rows = []
    for stage in dict.fromkeys(stem for run in runs for stem in run.manifests):
        told = []
        for run in runs:
            manifest = run.manifests.get(stage)
            told.append(None if manifest is None else dict(flat(told_to(manifest))))
        keys = dict.fromkeys(key for given in told if given for key in given)
        for key in keys:
            if len({repr(given.get(key)) for given in told if given is not None}) < 2:
                continue
            cells = [
                ABSENT if given is None else html.escape(shown(given.get(key), "default"))
                for given in told
            ]
            rows.append((f"{html.escape(stage)}: {named(key)}", *cells))
    if not rows:
        return (
            "<h2>Parameters</h2><p>All parameters of the stages that all runs have are the "
            "same.</p>"
        )
    return f"<h2>Parameters that differ</h2>{table(_head(runs), rows, 'numbers')}"


def _timings(runs: Sequence[Compared]) -> str:
    """Time in seconds and peak memory of each stage."""
    stems = [name for name in STAGES if any(name in run.manifests for run in runs)]
    stems += sorted({s for run in runs for s in run.manifests if s.startswith("evaluate-")})
    rows = []
    for stem in stems:
        cells = []
        for run in runs:
            took = run.manifests[stem]["volatile"] if stem in run.manifests else None
            memory = "" if took is None or took["peak_memory_mb"] is None else (
                f", {took['peak_memory_mb']:,.0f} MB"
            )  # fmt: skip
            cells.append(ABSENT if took is None else f"{took['wall_seconds']:.1f} s{memory}")
        rows.append((html.escape(stem), *cells))
    total = [sum(m["volatile"]["wall_seconds"] for m in run.manifests.values()) for run in runs]
    rows.append(("together", *(f"{seconds:.1f} s" for seconds in total)))
    return f"<h2>Time and peak memory</h2>{table(_head(runs), rows, 'numbers')}"


def _warnings(runs: Sequence[Compared]) -> str:
    parts = []
    for run in runs:
        lines = "".join(
            f'<p class="warn">{html.escape(f"{stage}: {text}")}</p>'
            for stage, manifest in run.manifests.items()
            for text in manifest["warnings"]
        )
        parts.append(f"<h3>{html.escape(run.name)}</h3>{lines or '<p>None.</p>'}")
    return f"<h2>Warnings</h2>{''.join(parts)}"


def _pictures(runs: Sequence[Compared]) -> str:
    figures = []
    for run in runs:
        image = surfaces(run.folder, PICTURE)
        if image is not None:
            figures.append(picture(run.name, image_file.png(image), run.name))
    return "<h2>Pictures</h2>" + "".join(figures) if figures else ""
