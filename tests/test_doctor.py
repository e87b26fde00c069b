"""``vorolight doctor``: on this machine, and on ones that lack something."""

from __future__ import annotations

import json
import os
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import Cli

from vorolight.stages import memory
from vorolight.stages.artifacts import atomic
from vorolight.stages.engine.doctor import checks, installation, machine


def test_this_machine_is_sound_and_stays_as_it_was(tmp_path: Path, program: Cli) -> None:
    cache = tmp_path / "cache"
    folder = tmp_path / "here"
    folder.mkdir()
    done = program("doctor", "--json", cwd=folder, env={"NUMBA_CACHE_DIR": str(cache)})
    assert done.returncode == 0, done.stdout
    found = {each["name"]: each for each in map(json.loads, done.stdout.splitlines())}
    assert {each["verdict"] for each in found.values()} <= {"ok", "note"}
    for name in ("numpy", "torch", "pymeshlab"):
        assert found[name]["found"].startswith(metadata.version(name))
    for name in (
        "Delaunay by scipy",
        "torch operations",
        "solids",
        "mesh repair",
        "compiled loops",
        "files",
    ):
        assert found[name]["verdict"] == "ok"
    assert str(cache) in found["compiled loops"]["found"]
    assert list(folder.iterdir()) == []
    assert [path for path in cache.rglob("*") if path.is_file()] == []


def test_broken_libraries_are_problems_and_the_other_checks_go_on(
    tmp_path: Path, program: Cli
) -> None:
    (tmp_path / "manifold3d.py").write_text("raise ImportError('libsomething.so is missing')")
    (tmp_path / "igl.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGILL)")
    done = program("doctor", cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 69
    assert done.stderr.count("\n") == 1
    assert "2 problems found (distances, solids)" in done.stderr
    lines = {line[9:28].strip(): line for line in done.stdout.splitlines()}
    assert lines["distances"].startswith("problem")
    assert "crashed with exit code -4" in lines["distances"]
    assert "libsomething.so is missing" in lines["solids"]
    assert lines["3MF"].startswith("ok")
    assert lines["files"].startswith("ok")
    assert "Traceback" not in done.stdout


def test_a_check_that_never_ends_is_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "manifold3d.py").write_text("import time\ntime.sleep(100)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(checks, "SECONDS", 1)
    (found,) = checks.examine(tmp_path, ["solids"])
    assert (found.name, found.verdict) == ("solids", "problem")
    assert "did not end within 1 s" in found.found


def test_libraries_are_measured_by_the_declared_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    declared = installation.requirements(None)
    assert ("numpy", "2.0") in declared
    assert all(name != "shull" for name, _ in declared)
    real = metadata.version

    def other(name: str) -> str:
        if name == "scipy":
            raise metadata.PackageNotFoundError(name)
        return {"numpy": "1.26.4", "torch": "2.4.0+cpu", "h5py": "3.9"}.get(name) or real(name)

    monkeypatch.setattr(installation.metadata, "version", other)
    found = {each.name: each for each in installation.libraries(Path())}
    assert set(found) == {name for name, _ in declared}
    bad = {name for name, each in found.items() if each.verdict == "problem"}
    assert bad == {"scipy", "numpy", "h5py"}
    assert found["scipy"].advice == "run: pip install --upgrade 'scipy>=1.13'"
    assert found["numpy"].found == "1.26.4, older than 2.0"


def test_every_extra_of_users_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    declared = set(metadata.metadata("vorolight").get_all("Provides-Extra") or [])
    assert set(installation.ENABLES) == declared - {"test", "bench"}
    monkeypatch.setattr(installation, "_version", lambda name: None)
    for each in installation.extras(Path()):
        assert each.verdict == "note"
        assert each.advice is not None
        assert f"'vorolight[{each.name.removeprefix('extra ')}]'" in each.advice


def test_folders_that_cannot_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*words: object, **more: object) -> None:
        raise OSError(30, "Read-only file system")

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", lambda *words: refused() if "trial" in str(words[0]) else None)
        (found,) = machine.files(tmp_path / "a.vorolight" / "later")
        assert (found.verdict, "hard links" in found.found) == ("note", False)
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "fsync", refused)
        (found,) = machine.files(tmp_path)
        assert found.verdict == "problem"
        assert "Read-only file system" in found.found
    assert list(tmp_path.iterdir()) == []


def test_full_disks_and_network_disks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import psutil

    parts = [
        SimpleNamespace(mountpoint="/", fstype="ext4"),
        SimpleNamespace(mountpoint=str(tmp_path.resolve()), fstype="nfs4"),
    ]
    monkeypatch.setattr(psutil, "disk_partitions", lambda all: parts)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda place: SimpleNamespace(free=5e7))
    room, kind = machine.disk(tmp_path / "a.vorolight")
    assert (room.verdict, kind.verdict) == ("problem", "note")
    assert "nfs4" in kind.found


def test_what_a_container_grants_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(machine, "available_threads", lambda: 4)
    (tmp_path / "memory.max").write_text("700000000\n")
    (tmp_path / "memory.current").write_text("200000000\n")
    (tmp_path / "cpu.max").write_text("250000 100000\n")
    (found,) = machine.memory_there(tmp_path)
    assert found.verdict == "problem"
    assert "0.5 GB free" in found.found
    assert "0.7 for its container" in found.found
    (found,) = machine.threads(tmp_path)
    assert (found.verdict, found.advice) == ("note", "give --threads 2")
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (found,) = machine.threads(tmp_path)
    assert found.verdict == "ok"
