"""Run stages, and commit the result of a finished one."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import socket
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from vorolight import schemas

from .. import memory
from ..artifacts import atomic, fingerprint, lock, log, manifest, randomness, requeue
from ..artifacts.run_folder import RunFolder
from ..errors import ArtifactError, BackendMissing, InputError, Locked, UsageError
from ..inputs.resolve import Identity, identify, kind_of
from .freshness import State, check_same_input, input_of, relative, state, takes_input
from .params import StageParams, options
from .registry import get
from .session import Session
from .stage import Context, Stage


@dataclass(frozen=True)
class Result:
    """A finished stage: its manifest, and whether it ran now or was up to date."""

    manifest: manifest.Manifest
    ran: bool
    reason: str | None


def execute(session: Session, name: str, params: StageParams) -> Result:
    """Run a stage unless its result is up to date. Its parents must be up to date.

    Raises ArtifactError if a parent is missing or stale, and whatever the stage raises. A stage
    that failed leaves nothing but its checkpoints; an older result of it stays.
    """
    requeue.stop_if_asked()
    check_same_input(session.folder, session.input)
    _check_device(session.device)
    stage = get(name)
    found = _standing(session, stage, params)
    if found is not None:
        _tidy(session.folder, stage.stem_of(params), found.manifest["fingerprint"])
        return found
    source = input_of(session)
    if source is None:
        raise UsageError("give an INPUT: a mesh file or the name of a built-in field")
    if name == "classify":
        opened = source.open()  # Refuse a bad input before anything is written.
        sources: Callable[[], Any] = lambda: opened  # noqa: E731
    else:
        sources = cache(partial(_open_recorded, session.folder, source))
    created = [p for p in (session.folder.path, *session.folder.path.parents) if not p.exists()]
    atomic.make_folder(session.folder.path)
    try:
        with lock.locked(session.folder.path) as notes:
            # Another process may have finished this stage, or changed its parents, meanwhile.
            found = _standing(session, stage, params)
            if found is not None:
                return found
            atomic.sweep(session.folder.path)
            now = state(session, name, params)
            written = _run(session, stage, params, now, source, sources, notes)
    finally:
        _remove_unused(session.folder, created)
    return Result(written, ran=True, reason=now.reason)


def _tidy(run: RunFolder, stem: str, digest: str) -> None:
    """Remove files that a killed process left behind after its result was written."""
    checkpoints, staging = run.checkpoints(stem, digest), run.path / f".{stem}{atomic.STAGING}"
    dead = (run.path / lock.NAME).exists() and lock.holder(run.path) is None
    place = checkpoints.folder.parent
    empty = place.parent.exists() and not any(place.parent.iterdir())
    if not (dead or staging.exists() or place.exists() or empty):
        return
    # If another process is running, or nothing can be written, the leftover files do no harm.
    with contextlib.suppress(Locked, UsageError), lock.locked(run.path):
        atomic.sweep(run.path)
        checkpoints.clear()


def _remove_unused(run: RunFolder, created: list[Path]) -> None:
    """Remove the folders in ``created`` if the stage left nothing but a log."""
    if run.path in created and {entry.name for entry in run.path.iterdir()} <= {log.FOLDER}:
        shutil.rmtree(run.path / log.FOLDER, ignore_errors=True)
    for folder in created:
        if not any(folder.iterdir()):
            folder.rmdir()


def _standing(session: Session, stage: Stage, params: StageParams) -> Result | None:
    """The result of a stage if it is up to date, else None. Raises ArtifactError if a parent is
    not."""
    for parent in stage.parents(params):
        found = state(session, parent)
        if not found.done:
            raise ArtifactError(
                f"{session.folder.path}: stage {parent} is not up to date ({found.reason}); "
                f"run: {' '.join(['vorolight', parent, *_arguments(found.stage, found.params)])}"
            )
    now = state(session, stage.name, params)
    if not now.done or session.force or now.manifest is None:
        return None
    if session.touch:
        before = [session.folder.file(parent, "json") for parent in stage.parents(params)]
        atomic.touch(session.folder.file(stage.stem_of(params), "json"), before)
    return Result(now.manifest, ran=False, reason=None)


def _check_device(device: str) -> None:
    if device == "cpu":
        return
    import torch

    if not torch.cuda.is_available():
        raise BackendMissing(f"--device {device}: torch finds no CUDA device; use --device cpu")


def _open_recorded(folder: RunFolder, source: Identity) -> Any:
    if source.path is not None and not source.path.exists():
        raise InputError(
            f"{source.path}: the input of {folder.path} is missing; restore it, or give its "
            "new path as INPUT"
        )
    return source.open(folder.arrays("classify", "classify"))


def _run(
    session: Session,
    stage: Stage,
    params: StageParams,
    now: State,
    source: Identity,
    sources: Callable[[], Any],
    notes: list[str],
) -> manifest.Manifest:
    stem = stage.stem_of(params)
    told = log.StageLog(session.folder.path, stem, session.progress)
    try:
        told.event(
            "start", command=command_line(session, stage, params, source), reason=now.reason,
            fingerprint=now.fingerprint, threads=session.threads, host=socket.gethostname(),
            tool_version=tool_version(),
        )  # fmt: skip
        written = _outcome(session, stage, params, now, source, sources, told, notes)
        told.event(
            "done", seconds=written["volatile"]["wall_seconds"], warnings=written["warnings"]
        )
    except BaseException as error:
        told.event(
            "failed", kind=type(error).__name__, reason=str(error), traceback=traceback.format_exc()
        )
        raise
    finally:
        told.close()
    return written


def _outcome(
    session: Session,
    stage: Stage,
    params: StageParams,
    now: State,
    source: Identity,
    sources: Callable[[], Any],
    told: log.StageLog,
    notes: list[str],
) -> manifest.Manifest:
    stem = stage.stem_of(params)
    checkpoints = session.folder.checkpoints(stem, now.fingerprint, told.event)
    context = Context(
        params=params,
        folder=session.folder,
        source=sources,
        seed=session.seed,
        threads=session.threads,
        device=session.device,
        progress=told,
        checkpoints=checkpoints,
        random=partial(randomness.generator, session.seed, stage.name),
    )
    needed = stage.memory(context)
    told.note(f"{stage.name}: about {needed / 1000:.1f} GB of memory")
    memory.require(stage.name, needed, session.max_memory_mb)
    wall, cpu = time.perf_counter(), time.process_time()
    import scipy.linalg  # noqa: F401  (with numpy's, all linear algebra there is to be limited)
    from threadpoolctl import threadpool_limits

    from ..voronoi.diagram.delaunay import backend

    try:
        # Sums of linear algebra depend on the number of threads, and waiting threads take time.
        with threadpool_limits(1, "blas"), backend(session.backend) as used:
            outcome = stage.run(context)
    finally:
        told.finish()
    from ..artifacts.hdf5 import encode

    files = {"h5": encode(stage.name, outcome.arrays, {"stage": stage.name}), **outcome.files}
    staging = session.folder.path / f".{stem}{atomic.STAGING}"
    atomic.make_folder(staging)
    staged = {suffix: staging / f"{stem}.{suffix}" for suffix in sorted(files)}
    try:
        outputs, times = [], {}
        for suffix, path in staged.items():
            atomic.write(path, files[suffix])
            times[path.name] = path.stat().st_mtime_ns
            digest = fingerprint.of_bytes(files[suffix])
            output = {"role": suffix, "path": path.name, "bytes": len(files[suffix])}
            outputs.append({**output, "sha256": digest})
        metrics = outcome.metrics
        if outcome.recheck is not None:
            metrics = metrics | {"as_written": outcome.recheck(staged)}
        parents = {name: state(session, name).fingerprint for name in stage.parents(params)}
        inputs = [_input_entry("input", source, session.folder.path)] if takes_input(stage) else []
        for role, text in stage.extra_inputs(params).items():
            inputs.append(_input_entry(role, identify(text), session.folder.path))
        record = {
            "schema": schemas.identifier(stage.name),
            "stage": stage.name,
            "status": "complete",
            "tool_version": tool_version(),
            "stage_code_version": stage.version,
            "command": command_line(session, stage, params, source),
            "params": params.as_json(),
            "seed": session.seed,
            "device": session.device,
            "bitwise": session.device == "cpu",
            "backend": session.backend,
            "inputs": inputs,
            "parents": parents,
            "outputs": outputs,
            "fingerprint": now.fingerprint,
            "frame": outcome.frame or _frame(session.folder),
            "metrics": metrics,
            "warnings": outcome.warnings + [said for said in [used.warning()] if said],
            "volatile": {
                "mtime_ns": times,
                "wall_seconds": round(time.perf_counter() - wall, 3),
                "cpu_seconds": round(time.process_time() - cpu, 3),
                "memory_estimate_mb": round(needed, 1),
                "peak_memory_mb": memory.peak_mb(),
                "threads": session.threads,
                "host": socket.gethostname(),
                "versions": _versions(),
                "notes": notes,
            },
        }
        encoded = manifest.encode(manifest.clean_numbers(record))
        staged_manifest = staging / f"{stem}.json"
        atomic.write(staged_manifest, encoded)
        # Everything is on the disk now, so the rest needs no more space. Until the last move the
        # stage counts as not done.
        _remove_left_over(session.folder, stem, set(staged))
        for path in [*staged.values(), staged_manifest]:
            atomic.move(path, session.folder.path / path.name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    checkpoints.clear()
    return manifest.read(session.folder.file(stem, "json"))


def _remove_left_over(folder: RunFolder, stem: str, roles: set[str]) -> None:
    """Remove files that the old manifest lists and the new one does not.

    This happens while the old manifest still exists, so that they are known after a crash.
    """
    for entry in (folder.manifest(stem) or {}).get("outputs", []):
        path = folder.path / str(entry["path"])
        if entry["role"] not in roles and path.name == f"{stem}.{entry['role']}":
            atomic.remove(path)


def _input_entry(role: str, source: Identity, folder: Path) -> dict[str, Any]:
    return {
        "role": role,
        "kind": source.kind,
        "name": source.name,
        "path": None if source.path is None else relative(source.path, folder),
        "bytes": source.bytes,
        "sha256": source.sha256,
    }


def _frame(folder: RunFolder) -> dict[str, Any]:
    stored = folder.manifest("classify")
    if stored is None:
        raise ArtifactError(f"{folder.path}: stage classify is not done; run: vorolight classify")
    return dict(stored["frame"])


def command_line(session: Session, stage: Stage, params: StageParams, source: Identity) -> str:
    """A command line that runs a stage again, from the folder that contains the run folder."""
    words = ["vorolight", stage.name, *_arguments(stage, params)]
    if stage.name == "classify":
        if source.path is not None:
            words.append(relative(source.path, _beside(session)))
            if source.kind != kind_of(source.path):
                words += ["--kind", source.kind]
        else:
            words += [source.name] if source.built_in else ["--field", source.name]
    for option in options(stage.params):
        value = getattr(params, option.name)
        if value == option.default or option.positional:
            continue
        if isinstance(value, bool):
            words.append(option.flag if value else "--no-" + option.flag[2:])
        else:
            words += [option.flag, str(value)]
    words += ["--seed", str(session.seed)] if session.seed else []
    words += ["--allow-code"] if session.allow_code else []
    words += ["--device", session.device] if session.device != "cpu" else []
    words += ["--backend", session.backend] if session.backend != "scipy" else []
    return shlex.join(words)


def _arguments(stage: Stage, params: StageParams) -> list[str]:
    return [str(getattr(params, o.name)) for o in options(stage.params) if o.positional]


def _beside(session: Session) -> Path:
    return session.folder.path.resolve().parent


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
    for name in ("numpy", "scipy", "torch", "trimesh", "manifold3d", "libigl", "h5py"):
        found[name] = metadata.version(name)
    return found
