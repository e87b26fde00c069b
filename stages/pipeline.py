"""Running stages: what is done, what is stale and why, and the commit of a finished one."""

from __future__ import annotations

import importlib
import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from vorolight import schemas

from .artifacts import atomic, fingerprint, lock, manifest, randomness
from .artifacts.run_folder import RunFolder
from .contract import Context, Params, Progress, Silent, Stage, options
from .errors import ArtifactError, BackendMissing, InputError, UsageError, VorolightError
from .sources.resolve import Identity, identify

ORDER = ("classify", "init", "sphere-train", "volume", "evaluate", "fabricate")
BACKEND = "scipy"


def get(name: str) -> Stage:
    """The stage called ``name``; its module is imported here and not before."""
    module = importlib.import_module(f"{__package__}.{name.replace('-', '_')}")
    stage: Stage = module.STAGE
    return stage


def available_threads() -> int:
    """Processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Session:
    """What one command line says about every stage it runs."""

    folder: RunFolder
    input: Identity | None = None
    seed: int = 0
    threads: int = field(default_factory=available_threads)
    device: str = "cpu"
    force: bool = False
    touch: bool = False
    verify: bool = False
    progress: Progress = field(default_factory=Silent)


@dataclass(frozen=True)
class State:
    """Whether a stage's result stands. ``reason`` says why it does not."""

    stage: Stage
    params: Params
    fingerprint: str
    reason: str | None
    manifest: manifest.Manifest | None

    @property
    def done(self) -> bool:
        return self.reason is None


@dataclass(frozen=True)
class Result:
    """A finished stage: its manifest, and whether it ran now or stood already."""

    manifest: manifest.Manifest
    ran: bool
    reason: str | None


def recorded_input(folder: RunFolder) -> Identity | None:
    """The input that the run folder's classify stage recorded, as it is on disk now.

    A file that is gone keeps the recorded hash: what was made from it is not stale for that.
    """
    stored = folder.manifest("classify")
    if stored is None:
        return None
    entry = stored["inputs"][0]
    if entry["path"] is None:
        return Identity(entry["kind"], entry["name"], None, None, None)
    path = folder.path / entry["path"]
    if not path.is_file():
        return Identity(entry["kind"], entry["name"], path, entry["bytes"], entry["sha256"])
    return Identity(
        entry["kind"], entry["name"], path, path.stat().st_size, fingerprint.of_file(path)
    )


def check_same_input(folder: RunFolder, given: Identity | None) -> None:
    """Raise ArtifactError when the run folder was made from another input than ``given``."""
    stored = folder.manifest("classify") if given else None
    if stored is None or given is None:
        return
    entry = stored["inputs"][0]
    if entry["name"] != given.name and (entry["sha256"] is None or entry["sha256"] != given.sha256):
        raise ArtifactError(
            f"{folder.path}: holds a run of {entry['name']}, not of {given.name}; "
            "name another folder with --run"
        )


def state(session: Session, name: str, params: Params | None = None) -> State:
    """Where a stage stands. Without ``params`` those recorded in its manifest are taken."""
    stage = get(name)
    if params is None:
        stem = stage.stem_of(stage.params())
        stored = session.folder.manifest(stem)
        params = stage.params(**_known(stage, stored["params"])) if stored else stage.params()
        seed = int(stored["seed"]) if stored else session.seed
        device = str(stored["device"]) if stored else session.device
    else:
        stored = session.folder.manifest(stage.stem_of(params))
        seed, device = session.seed, session.device
    parents = [state(session, parent) for parent in stage.parents(params)]
    source = (session.input or recorded_input(session.folder)) if _takes_input(stage) else None
    extra = {role: identify(str(path)) for role, path in stage.extra_inputs(params).items()}
    payload = {
        "stage": stage.name,
        "version": stage.version,
        "params": params.as_json(),
        "seed": seed,
        "device": device,
        "backend": BACKEND,
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
        reason = _difference(session, stage, params, (seed, device), stored, source, extra, parents, digest)
    return State(stage, params, digest, reason, stored)


def _known(stage: Stage, recorded: dict[str, Any]) -> dict[str, Any]:
    names = {option.name for option in options(stage.params)}
    return {key: value for key, value in recorded.items() if key in names}


def _takes_input(stage: Stage) -> bool:
    return stage.reads_input or stage.name == "classify"


def _difference(
    session: Session,
    stage: Stage,
    params: Params,
    seed_device: tuple[int, str],
    stored: manifest.Manifest | None,
    source: Identity | None,
    extra: dict[str, Identity],
    parents: list[State],
    digest: str,
) -> str | None:
    """Why the stored result is not the one asked for, in words; None if it is."""
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
        seed, device = seed_device
        for key, value in (("seed", seed), ("device", device), ("backend", BACKEND)):
            if stored[key] != value:
                return f"{key} {stored[key]} -> {value}"
        return f"the stage's code is another version ({stored['stage_code_version']})"
    if stage.name == "classify" and session.input and source and source.path:
        if recorded["input"]["path"] != _relative(source.path, session.folder.path):
            return f"{source.path.name} was moved"
    return manifest.outputs_changed(session.folder.path, stored, session.verify)


def execute(session: Session, name: str, params: Params) -> Result:
    """Run a stage unless its result stands; its parents must stand.

    Raises ArtifactError when a parent is missing or stale, and whatever the stage raises. Nothing
    is left of a stage that failed but its checkpoints.
    """
    check_same_input(session.folder, session.input)
    _check_device(session.device)
    stage = get(name)
    for parent in stage.parents(params):
        found = state(session, parent)
        if not found.done:
            raise ArtifactError(
                f"{session.folder.path}: stage {parent} is not up to date ({found.reason}); "
                f"run: vorolight {parent}"
            )
    now = state(session, name, params)
    if now.done and not session.force and now.manifest is not None:
        if session.touch:
            os.utime(session.folder.file(stage.stem_of(params), "json"))
        return Result(now.manifest, ran=False, reason=None)
    source = session.input or recorded_input(session.folder)
    if source is None:
        raise UsageError("give an INPUT: a mesh file or the name of a built-in field")
    if name == "classify":
        opened = source.open()  # a bad input is refused before anything is written
        sources: Callable[[], Any] = lambda: opened  # noqa: E731
    else:
        sources = partial(_open_recorded, session.folder, source)
    created = not session.folder.path.exists()
    atomic.make_folder(session.folder.path)
    try:
        with lock.locked(session.folder.path) as notes:
            atomic.sweep(session.folder.path)
            written = _run(session, stage, params, now, source, sources, notes)
    finally:
        if created and not any(session.folder.path.iterdir()):
            session.folder.path.rmdir()
    return Result(written, ran=True, reason=now.reason)


def _check_device(device: str) -> None:
    if device == "cpu":
        return
    import torch

    if not torch.cuda.is_available():
        raise BackendMissing(f"--device {device}: torch finds no CUDA device; use --device cpu")


def _open_recorded(folder: RunFolder, source: Identity) -> Any:
    if source.path is not None and not source.path.is_file():
        raise InputError(
            f"{source.path}: the input of {folder.path} is gone; put it back or give it as INPUT"
        )
    return source.open()


def _run(
    session: Session,
    stage: Stage,
    params: Params,
    now: State,
    source: Identity,
    sources: Callable[[], Any],
    notes: list[str],
) -> manifest.Manifest:
    stem = stage.stem_of(params)
    checkpoints = session.folder.checkpoints(stem, now.fingerprint)
    context = Context(
        params=params,
        folder=session.folder,
        source=sources,
        seed=session.seed,
        threads=session.threads,
        device=session.device,
        progress=session.progress,
        checkpoints=checkpoints,
        random=partial(randomness.generator, session.seed, stage.name),
    )
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        outcome = stage.run(context)
    finally:
        session.progress.finish()
    from .artifacts.hdf5 import encode

    files = {"h5": encode(stage.name, outcome.arrays, {"stage": stage.name}), **outcome.files}
    outputs, times = [], {}
    paths = {suffix: session.folder.file(stem, suffix) for suffix in sorted(files)}
    session.folder.file(stem, "json").unlink(missing_ok=True)
    for suffix, path in paths.items():
        data = files[suffix]
        atomic.write(path, data)
        times[path.name] = path.stat().st_mtime_ns
        outputs.append(
            {
                "role": suffix,
                "path": path.name,
                "bytes": len(data),
                "sha256": fingerprint.of_bytes(data),
            }
        )
    metrics = outcome.metrics
    if outcome.recheck is not None:
        try:
            metrics = metrics | {"as_written": outcome.recheck(paths)}
        except VorolightError:
            for path in paths.values():
                path.unlink(missing_ok=True)
            raise
    parents = {name: state(session, name).fingerprint for name in stage.parents(params)}
    inputs = [_input_entry("input", source, session.folder.path)] if _takes_input(stage) else []
    for role, path in stage.extra_inputs(params).items():
        inputs.append(_input_entry(role, identify(str(path)), session.folder.path))
    record = {
        "schema": schemas.identifier(stage.name),
        "stage": stage.name,
        "status": "complete",
        "tool_version": tool_version(),
        "stage_code_version": stage.version,
        "command": command_line(stage, params, session.seed),
        "params": params.as_json(),
        "seed": session.seed,
        "device": session.device,
        "backend": BACKEND,
        "inputs": inputs,
        "parents": parents,
        "outputs": outputs,
        "fingerprint": now.fingerprint,
        "frame": outcome.frame or _frame(session.folder),
        "metrics": metrics,
        "warnings": outcome.warnings,
        "volatile": {
            "mtime_ns": times,
            "wall_seconds": round(time.perf_counter() - wall, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
            "peak_memory_mb": peak_memory_mb(),
            "threads": session.threads,
            "host": socket.gethostname(),
            "versions": _versions(),
            "notes": notes,
        },
    }
    clean: manifest.Manifest = manifest.clean_numbers(record)
    atomic.write(session.folder.file(stem, "json"), manifest.encode(clean))
    checkpoints.clear()
    return clean


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive on Windows
        return path.resolve().as_posix()


def _input_entry(role: str, source: Identity, folder: Path) -> dict[str, Any]:
    return {
        "role": role,
        "kind": source.kind,
        "name": source.name,
        "path": None if source.path is None else _relative(source.path, folder),
        "bytes": source.bytes,
        "sha256": source.sha256,
    }


def _frame(folder: RunFolder) -> dict[str, Any]:
    stored = folder.manifest("classify")
    if stored is None:
        raise ArtifactError(f"{folder.path}: stage classify is not done; run: vorolight classify")
    return dict(stored["frame"])


def command_line(stage: Stage, params: Params, seed: int) -> str:
    """A command line that repeats a stage with these parameters."""
    words = ["vorolight", stage.name]
    for option in options(stage.params):
        value = getattr(params, option.name)
        if value == option.default:
            continue
        if isinstance(value, bool):
            words.append(option.flag if value else "--no-" + option.flag[2:])
        else:
            words += [option.flag, str(value)]
    return " ".join(words + (["--seed", str(seed)] if seed else []))


def tool_version() -> str:
    from importlib import metadata

    try:
        return metadata.version("vorolight")
    except metadata.PackageNotFoundError:
        return "0+uninstalled"


def _versions() -> dict[str, str]:
    import platform
    from importlib import metadata

    found = {"python": platform.python_version()}
    for name in ("numpy", "scipy", "torch", "trimesh", "manifold3d", "h5py"):
        found[name] = metadata.version(name)
    return found


def peak_memory_mb() -> float | None:
    """Peak resident memory of this process so far, in MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024**2 if sys.platform == "darwin" else 1024), 1)


def overall(session: Session) -> list[State]:
    """Where every stage of a run folder stands, evaluations of each stage included."""
    states = [state(session, name) for name in ORDER if name != "evaluate"]
    stage = get("evaluate")
    for path in sorted(session.folder.path.glob("evaluate-*.json")):
        stored = manifest.read(path)
        states.append(state(session, "evaluate", stage.params(**_known(stage, stored["params"]))))
    return states


