"""The state of a run: which stages are done, and which are stale and why."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..artifacts import fingerprint, manifest
from ..artifacts.run_folder import RunFolder
from ..errors import ArtifactError, InputError, UsageError
from ..inputs.resolve import Identity, identify, identify_field, identify_path
from .params import StageParams, options
from .registry import ALL, ORDER, get
from .session import Session
from .stage import Stage

SETTINGS = ("seed", "device", "backend")
"""The settings of a session on which results depend."""


@dataclass(frozen=True)
class State:
    """Whether a stage's result is up to date; ``reason`` says why it is not."""

    stage: Stage
    params: StageParams
    fingerprint: str
    reason: str | None
    manifest: manifest.Manifest | None

    @property
    def done(self) -> bool:
        return self.reason is None


def recorded_input(folder: RunFolder) -> Identity | None:
    """The input that stage classify recorded, as it is on disk now.

    An input that is missing keeps its recorded hash, so that its results do not become stale.
    """
    stored = folder.manifest("classify")
    if stored is None:
        return None
    entry = stored["inputs"][0]
    if entry["path"] is None:
        try:
            return identify_field(entry["name"])
        except InputError:  # the module of a function is missing
            return Identity(entry["kind"], entry["name"], None, None, entry["sha256"])
    path = folder.path / entry["path"]
    gone = Identity(entry["kind"], entry["name"], path, entry["bytes"], entry["sha256"])
    if not path.exists():
        return gone
    try:
        return identify_path(entry["kind"], path)
    except InputError:  # a picture of a set of views is missing
        return gone


def input_of(session: Session) -> Identity | None:
    """The given input, else the recorded one, with the session's permission to run code."""
    found = session.input or recorded_input(session.folder)
    return found and replace(found, allow_code=session.allow_code)


def _extra_input(
    folder: RunFolder, stored: manifest.Manifest | None, role: str, text: str
) -> Identity:
    """A further input as it is now; a missing one keeps its recorded hash."""
    entries = stored["inputs"] if stored else []
    entry = next((entry for entry in entries if entry["role"] == role), None)
    if entry is not None and entry["path"] is not None:
        place = folder.path / entry["path"]
        if not place.exists():
            return Identity(entry["kind"], entry["name"], place, entry["bytes"], entry["sha256"])
        if not Path(text).exists():
            return identify(str(place))
    return identify(text)


def check_same_input(folder: RunFolder, given: Identity | None) -> None:
    """Raise ArtifactError if the run folder was made from another input than ``given``."""
    stored = folder.manifest("classify") if given else None
    if stored is None or given is None:
        return
    entry = stored["inputs"][0]
    if entry["kind"] == given.kind:
        if given.path is None:
            same = entry["name"] == given.name
        else:
            place = relative(given.path, folder.path)
            same = entry["path"] == place or entry["sha256"] == given.sha256
    else:
        same = False
    if not same:
        raise ArtifactError(
            f"{folder.path}: contains a run of {entry['path'] or entry['name']}, not of "
            f"{given.path or given.name}; name another folder with --run"
        )


def state(session: Session, name: str, params: StageParams | None = None) -> State:
    """The state of a stage. Without ``params`` the parameters in its manifest are used."""
    stage = get(name)
    if params is None:
        stem = stage.stem_of(stage.params())
        stored = session.folder.manifest(stem)
        params = _recorded_params(session.folder, stage, stored) if stored else stage.params()
        settings = {key: stored[key] if stored else getattr(session, key) for key in SETTINGS}
    else:
        stored = session.folder.manifest(stage.stem_of(params))
        settings = {key: getattr(session, key) for key in SETTINGS}
    parents = [state(session, parent) for parent in stage.parents(params)]
    source = input_of(session) if takes_input(stage) else None
    extra = {
        role: _extra_input(session.folder, stored, role, path)
        for role, path in stage.extra_inputs(params).items()
    }
    payload = {
        "stage": stage.name,
        "version": stage.version,
        "params": params.as_json(),
        **settings,
        "inputs": {
            role: [item.kind, item.name if item.path is None else None, item.sha256]
            for role, item in ([("input", source)] if source else []) + list(extra.items())
        },
        "parents": {parent.stage.name: parent.fingerprint for parent in parents},
    }
    digest = fingerprint.of_json(payload)
    reason = None
    for parent in parents:
        if not parent.done:
            reason = f"{parent.stage.name}: {parent.reason}"
            break
    if reason is None:
        reason = _difference(
            session, stage, params, settings, stored, source, extra, parents, digest
        )
    return State(stage, params, digest, reason, stored)


def _known(stage: Stage, recorded: dict[str, Any]) -> dict[str, Any]:
    names = {option.name for option in options(stage.params)}
    return {key: value for key, value in recorded.items() if key in names}


def _recorded_params(folder: RunFolder, stage: Stage, stored: manifest.Manifest) -> StageParams:
    try:
        return stage.params(**_known(stage, stored["params"]))
    except UsageError as error:  # they were written by another hand
        raise ArtifactError(
            f"{folder.path}: the manifest of {stage.name} has invalid options ({error}); "
            f"run: vorolight {stage.name} --force"
        ) from error


def takes_input(stage: Stage) -> bool:
    return stage.reads_input or stage.name == "classify"


def _difference(
    session: Session,
    stage: Stage,
    params: StageParams,
    settings: dict[str, Any],
    stored: manifest.Manifest | None,
    source: Identity | None,
    extra: dict[str, Identity],
    parents: list[State],
    digest: str,
) -> str | None:
    """Why the stored result does not fit the request, in words; None if it fits."""
    if stored is None:
        return "not done"
    recorded = {entry["role"]: entry for entry in stored["inputs"]}
    items = ({"input": source} if source else {}) | extra
    for role, item in items.items():
        before = recorded.get(role)
        if before is None or before["sha256"] != item.sha256 or before["kind"] != item.kind:
            return f"{item.path.name if item.path else item.name} changed"
    if stored["fingerprint"] != digest:
        for key, value in params.as_json().items():
            if stored["params"].get(key) != value:
                return f"{key} {stored['params'].get(key)} -> {value}"
        for parent in parents:
            if stored["parents"].get(parent.stage.name) != parent.fingerprint:
                return f"{parent.stage.name} changed"
        for key, value in settings.items():
            if stored[key] != value:
                return f"{key} {stored[key]} -> {value}"
        return f"the stage's code has changed since version {stored['stage_code_version']}"
    if stage.name == "classify" and session.input is not None and session.input.path is not None:
        place = relative(session.input.path, session.folder.path)
        if recorded["input"]["path"] != place:
            return f"{session.input.path.name} was moved"
    return manifest.outputs_changed(session.folder.path, stored, session.verify)


def overall(session: Session) -> list[State]:
    """The states of all stages of a run folder, including evaluations of each stage.

    Stages that are not part of a whole run are included if they were run.
    """
    found = input_of(session)
    left_out = (
        {"evaluate"} if found is not None and found.kind == "views" else {"evaluate", "shade"}
    )
    states = [state(session, name) for name in ORDER if name not in left_out]
    states += [
        state(session, name) for name in ALL if name not in ORDER and session.folder.manifest(name)
    ]
    stage = get("evaluate")
    for path in sorted(session.folder.path.glob("evaluate-*.json")):
        stored = manifest.read(path)
        states.append(state(session, "evaluate", _recorded_params(session.folder, stage, stored)))
    return states


def relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive on Windows
        return path.resolve().as_posix()
