"""Checks of the machine: processors, memory, GPU, the folder for runs, and optional programs."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ... import memory
from ...artifacts import atomic, lock
from ...errors import BackendMissing, UsageError
from ..session import available_threads
from .finding import Finding

ENOUGH_GB, LEAST_GB = 3.0, 0.6
"""Memory for a whole run of the default size, and for its first stages, in GB."""
ROOM_GB, LEAST_ROOM_GB = 2.0, 0.1
"""Free disk space for a few runs, and for one, in GB."""
NETWORK = {
    "9p", "afs", "beegfs", "ceph", "cifs", "fuse.glusterfs", "fuse.sshfs", "gpfs", "lustre", "nfs",
    "nfs4", "panfs", "pvfs2", "smb3", "smbfs", "wekafs",
}  # fmt: skip
"""Kinds of file systems to which other machines may write at the same time."""
VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def threads(folder: Path) -> Iterator[Finding]:
    allowed, quota = available_threads(), _processor_quota()
    said = [f"{allowed} of {os.cpu_count()} cores for this process"]
    said += [f"{name}={os.environ[name]}" for name in VARIABLES if name in os.environ]
    if quota is not None and quota < allowed:
        said.append(f"the container may use the time of {quota:.3g} cores")
        advice = f"give --threads {max(1, int(quota))}"
        yield Finding("threads", ", ".join(said), "note", advice)
    else:
        yield Finding("threads", ", ".join(said))


def _processor_quota() -> float | None:
    """Processors whose time the container may use; None without a limit."""
    try:
        most, period = (memory.CONTROL_GROUP / "cpu.max").read_text().split()
        return float(most) / float(period)
    except (OSError, ValueError):  # no such limit: "max"
        return None


def memory_there(folder: Path) -> Iterator[Finding]:
    import psutil

    free = memory.free_mb() / 1000
    said = f"{free:.1f} GB free of {psutil.virtual_memory().total / 1e9:.1f}"
    try:
        limit = float((memory.CONTROL_GROUP / "memory.max").read_text())
        said += f", {limit / 1e9:.1f} for its container"
    except (OSError, ValueError):  # no such limit
        pass
    if free < LEAST_GB:
        yield Finding("memory", said, "problem", "end other programs, or use another machine")
    elif free < ENOUGH_GB:
        yield Finding(
            "memory", said, "note", "enough for small runs; lower -n if a stage is refused"
        )
    else:
        yield Finding("memory", said)


def gpu(folder: Path) -> Iterator[Finding]:
    import torch

    if torch.cuda.is_available():
        yield Finding("GPU", f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}")
    else:
        yield Finding("GPU", "torch finds none; everything runs on the processor", "note")


def disk(folder: Path) -> Iterator[Finding]:
    place = _existing(folder)
    room, kind = shutil.disk_usage(place).free / 1e9, _file_system(place)
    said = f"{room:.1f} GB free in {place}"
    if room < LEAST_ROOM_GB:
        yield Finding(
            "disk", said, "problem", "free some space, or choose another folder with --run"
        )
    elif room < ROOM_GB:
        yield Finding("disk", said, "note", "enough for small runs only")
    else:
        yield Finding("disk", said)
    if kind in NETWORK:
        advice = "only one process may work on a run folder at a time, on whichever machine"
        yield Finding("file system", f"{kind}, over the network", "note", advice)
    else:
        yield Finding("file system", kind or "of unknown kind", "ok" if kind else "note")


def _existing(folder: Path) -> Path:
    """``folder``, or the existing folder in which it would be created."""
    place = folder.resolve()
    while not place.is_dir():
        place = place.parent
    return place


def _file_system(place: Path) -> str | None:
    import psutil

    mounted = {part.mountpoint: str(part.fstype) for part in psutil.disk_partitions(all=True)}
    found = (mounted.get(str(parent)) for parent in (place, *place.parents))
    return next((kind for kind in found if kind), None)


def files(folder: Path) -> Iterator[Finding]:
    """Write files as runs do, in a temporary folder."""
    place = _existing(folder)
    try:
        with tempfile.TemporaryDirectory(prefix=".vorolight-doctor-", dir=place) as name:
            trial = Path(name) / "trial"
            for content in (b"first", b"second"):
                atomic.write(trial, content)
            if trial.read_bytes() != b"second":
                raise OSError("replacing a file had no effect")
            with lock.locked(Path(name)):
                pass
            try:
                os.link(trial, trial.with_name("link"))
                links = ", hard links"
            except OSError:
                links = ""
    except (OSError, UsageError) as error:
        reason = f"{place}: runs cannot be written there ({error})"
        yield Finding("files", reason, "problem", "choose another folder with --run")
        return
    said = f"{place}: writing, fsync, renaming{links} and locks work"
    if links:
        yield Finding("files", said)
    else:
        advice = (
            "without hard links two processes might take the same lock: do not start a run "
            "twice at once"
        )
        yield Finding("files", said, "note", advice)


def programs(folder: Path) -> Iterator[Finding]:
    from ...fabrication import slicer

    try:
        yield Finding("slicer", slicer.program())
    except BackendMissing as error:
        advice = str(error).rpartition("; ")[2]
        yield Finding("slicer", "none found; only --slice needs it", "note", advice)
    for name, purpose in (
        ("snakemake", "for workflows on many shapes"),
        ("sbatch", "for clusters with Slurm"),
    ):
        found = shutil.which(name)
        yield Finding(name, found or f"not on the path; {purpose}", "ok" if found else "note")
