"""``vorolight status``: what of a run is done, stale or running."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vorolight.stages.artifacts import lock, log
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import freshness
from vorolight.stages.engine.session import Session
from vorolight.stages.errors import ArtifactError

from .console import Console, table
from .session import Field, Input, Json, Kind, Run, Verbose, Verify, identity_of

if TYPE_CHECKING:
    from vorolight.stages.engine.freshness import State


def status(
    input: Input = None, field: Field = None, kind: Kind = None, run: Run = None,
    json: Json = False, verify: Verify = False, verbose: Verbose = False,
) -> None:  # fmt: skip
    """Show which stages are done, stale or running, and why. With --verify it compares the contents
    of all files with the recorded checksums, and ends with exit code 4 if one differs.

    Example: vorolight status --run bunny.vorolight --json
    """
    identity = identity_of(input, field, kind)
    folder = RunFolder.locate(run, None if identity is None else identity.stem)
    session = Session(folder=folder, input=identity, verify=verify)
    console = Console(1, json, True)
    holder = lock.holder(folder.path)
    rows = [("stage", "state", "why", "seconds")]
    damaged = []
    for found in freshness.overall(session):
        facts = _facts(folder, found, holder)
        console.data(facts)
        took, why = facts["seconds"], facts["reason"] if facts["state"] == "stale" else ""
        if facts["state"] == "running":
            why = facts["progress"]
        elif facts["checkpoint"] is not None and not found.done:
            why = f"{why}; " * bool(why) + f"checkpoint at {facts['checkpoint']}"
        rows.append((facts["stage"], facts["state"], why, "" if took is None else f"{took:.1f}"))
        if found.manifest and _of_a_file(found, folder):
            damaged.append(str(found.reason))
    console.say(f"{folder.path}\n{table(rows)}")
    if verify and damaged:
        raise ArtifactError(
            f"{folder.path}: files differ from what was written: {', '.join(damaged)}; run these "
            "stages again"
        )


def _of_a_file(found: State, folder: RunFolder) -> bool:
    """Whether a result is stale because one of its own files is missing or was changed."""
    assert found.manifest is not None
    names = [entry["path"] for entry in found.manifest["outputs"]]
    return any((found.reason or "").startswith(f"{name} ") for name in names)


def _facts(folder: RunFolder, found: State, holder: dict[str, Any] | None) -> dict[str, Any]:
    stem = found.stage.stem_of(found.params)
    events = log.read(folder.path, stem)
    last = events[-1] if events else {}
    runs = (
        holder is not None
        and last.get("pid") == holder["pid"]
        and last.get("event") not in ("done", "failed")
    )
    steps = [event for event in events if event.get("event") == "progress"]
    progress = None
    if runs and steps:
        progress = "{label}: {done} of {of}".format(**{"label": "", "done": 0, "of": 0} | steps[-1])
    kept = sorted((folder.path / "checkpoints" / stem).glob("*/[0-9]*.h5"))
    numbers = [int(path.stem) for path in kept if re.fullmatch(r"\d{1,9}", Path(path).stem)]
    failed = last.get("reason") if last.get("event") == "failed" else None
    return {
        "stage": stem,
        "state": "running"
        if runs
        else "done"
        if found.done
        else "to do"
        if found.manifest is None
        else "stale",
        "reason": found.reason,
        "seconds": found.manifest["volatile"]["wall_seconds"] if found.manifest else None,
        "checkpoint": max(numbers, default=None),
        "progress": progress or ("" if runs else None),
        "failed": failed,
        "holder": holder if runs else None,
    }
