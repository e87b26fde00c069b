"""Real disks that are full or read-only, other users' folders, and clocks that jump."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cases import (
    CLASSIFY,
    EVALUATE,
    INIT,
    TRAINED,
    TRIANGLES,
    VOLUME,
    Runs,
    differences,
    kept,
    run,
    run_folder,
)

NOBODY = 65534
VOLUMETRIC = (*TRAINED, VOLUME)


@contextmanager
def mounted(place: Path, *words: str) -> Iterator[None]:
    done = subprocess.run(["mount", *words, str(place)], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"no leave to mount: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def states(runs: Runs, place: Path, *words: str) -> list[str]:
    seen = run(runs.server, ("status", "--verify", "--json", *words), place)
    assert seen.code == 0, seen.stderr
    return [json.loads(line)["state"] for line in seen.stdout.splitlines()]


@pytest.mark.parametrize("more_kb", [0, 40])
def test_a_full_disk(more_kb: int, runs: Runs) -> None:
    before, expected = runs.after(CLASSIFY, INIT), kept(runs.after(*TRAINED))
    place = runs.folder / "full"
    place.mkdir(exist_ok=True)
    with mounted(place, "-t", "tmpfs", "-o", "size=8M", "tmpfs"):
        shutil.copytree(before, place, dirs_exist_ok=True)
        usage = os.statvfs(place)
        used = (usage.f_blocks - usage.f_bfree) * usage.f_frsize // 1024
        resize = ["mount", "-o", f"remount,size={used + more_kb}k", str(place)]
        subprocess.run(resize, check=True)
        done = run(runs.server, TRIANGLES, place)
        assert done.code == 2, done.stderr
        assert done.clean, done.stderr
        assert "No space left" in done.stderr
        assert states(runs, place)[:3] == ["done", "done", "to do"]
        subprocess.run(["mount", "-o", "remount,size=8M", str(place)], check=True)
        assert run(runs.server, TRIANGLES, place).code == 0
        assert differences(kept(place), expected) == ""


READ = (
    (("status",), 0),
    (("status", "--verify"), 0),
    (("export", "../elsewhere/cells.vtu"), 0),
    ((*INIT, "--dry-run"), 0),
    (TRIANGLES, 0),
    (EVALUATE, 2),
    ((*INIT, "--force"), 2),
    ((*INIT, "--touch"), 2),
)
"""Commands in a folder that cannot be written to, and how they end."""


def check_reading(runs: Runs, place: Path, **more: bool) -> None:
    before = kept(place)
    elsewhere = place.parent / "elsewhere"
    elsewhere.mkdir(exist_ok=True)
    elsewhere.chmod(0o777)
    for words, code in READ:
        done = run(runs.server, words, place, **more)
        assert done.code == code, f"{words}: {done.stderr}"
        assert code == 0 or done.clean, f"{words}: {done.stderr}"
        assert kept(place) == before
    whole = run(runs.server, ("export", "cells.vtu"), runs.copy("exported", *VOLUMETRIC))
    assert whole.code == 0
    copy = runs.folder / "exported" / "work" / "cells.vtu"
    assert (elsewhere / "cells.vtu").read_bytes() == copy.read_bytes()


def test_a_read_only_disk(runs: Runs) -> None:
    place = runs.copy("read-only", *VOLUMETRIC)
    with mounted(place, "--bind", str(place)):
        subprocess.run(["mount", "-o", "remount,ro,bind", str(place)], check=True)
        check_reading(runs, place)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_a_folder_of_somebody_else(runs: Runs) -> None:
    place = runs.copy("theirs", *VOLUMETRIC)
    for path in (place, *place.rglob("*")):
        os.chown(path, NOBODY, NOBODY)
    check_reading(runs, place, powerless=True)


def test_a_clock_that_jumps(runs: Runs) -> None:
    place = runs.copy("clock", CLASSIFY)
    for number, words in enumerate((INIT, TRIANGLES)):
        done = run(runs.server, words, place, fault={"clock": number})
        assert done.code == 0, done.stderr
        assert len(done.operations) > 15
    assert differences(kept(place), kept(runs.after(*TRAINED))) == ""
    assert states(runs, place)[:3] == ["done"] * 3
    folder = run_folder(place)
    times = {path.stat().st_mtime for path in folder.glob("*.*")}
    assert max(times) - min(times) > 1e6  # it did jump


def test_files_from_the_future(runs: Runs) -> None:
    place = runs.copy("future", CLASSIFY, INIT)
    folder = run_folder(place)
    for path in folder.iterdir():
        os.utime(path, (4e9, 4e9))
    assert states(runs, place)[:2] == ["done", "done"]
    os.utime(folder / "init.json", (1e9, 1e9))
    done = run(runs.server, (*INIT, "--touch"), place)
    assert done.code == 0, done.stderr
    assert "up to date" in done.stdout + done.stderr
    # Make must not take the stage for older than what it was made from.
    made = [(folder / f"{stem}.json").stat().st_mtime_ns for stem in ("classify", "init")]
    assert made[1] >= made[0]
    assert run(runs.server, TRIANGLES, place).code == 0
    assert differences(kept(place), kept(runs.after(*TRAINED))) == ""
    done = run(runs.server, (*TRIANGLES, "--touch"), place)
    made.append((folder / "sphere-train.json").stat().st_mtime_ns)
    assert done.code == 0
    assert made[2] >= made[1]
