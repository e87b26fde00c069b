"""Stages that run, are killed and go on: locks, checkpoints, status and logs."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from cases import snapshot, without_volatile
from conftest import Cli


def test_a_running_stage_holds_the_lock(tmp_path: Path, cli: Cli) -> None:
    run = tmp_path / "sphere.vorolight"
    run.mkdir()
    holder = {"host": os.uname().nodename, "pid": os.getpid()}
    (run / ".lock").write_text(json.dumps(holder))
    done = cli("classify", "sphere", "-n", 6, cwd=tmp_path)
    assert done.returncode == 75
    assert str(os.getpid()) in done.stderr


# Checkpoints of triangles are numbered from 0, those of polygons from 100000.
@pytest.mark.parametrize(
    ("signals", "words", "written"),
    [
        (
            [signal.SIGKILL, signal.SIGTERM, signal.SIGINT],
            ["--iterations", 60],
            "0*.h5",
        ),
        pytest.param(
            [signal.SIGKILL, signal.SIGUSR1],
            ["--iterations", 30, "--faces", "polygon"],
            "10000[3-9].h5",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_killed_in_the_middle_of_training(
    signals: list[signal.Signals], words: list[object], written: str, tmp_path: Path, cli: Cli
) -> None:
    start = ["init", "sphere", "-n", 7, "--iterations", 5, "--threads", 2]
    words = ["sphere-train", *words, "--threads", 2]
    (tmp_path / "begun").mkdir()
    assert cli(*start, cwd=tmp_path / "begun").returncode == 0
    shutil.copytree(tmp_path / "begun", tmp_path / "undisturbed")
    assert cli(*words, cwd=tmp_path / "undisturbed").returncode == 0
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words)]
    run = tmp_path / "killed" / "sphere.vorolight"
    checkpoints = run / "checkpoints" / "sphere-train"
    undisturbed = without_volatile(snapshot(tmp_path / "undisturbed" / "sphere.vorolight"))
    for number in signals:
        # On a busy machine the training may have ended before the signal came: then again.
        for _ in range(5):
            shutil.rmtree(tmp_path / "killed", ignore_errors=True)
            shutil.copytree(tmp_path / "begun", tmp_path / "killed")
            running = subprocess.Popen(command, cwd=run.parent, stderr=subprocess.DEVNULL)
            deadline = time.monotonic() + 120
            while not list(checkpoints.glob(f"*/{written}")) and time.monotonic() < deadline:
                time.sleep(0.01)
            running.send_signal(number)
            code = running.wait(timeout=60)
            if code != 0:
                break
        codes = {signal.SIGKILL: -9, signal.SIGUSR1: 85}
        assert code == codes.get(number, 128 + number)
        assert not (run / "sphere-train.json").exists()
        assert list(checkpoints.glob(f"*/{written}"))
        done = cli(*words, cwd=run.parent)
        assert done.returncode == 0, done.stderr
        assert without_volatile(snapshot(run)) == undisturbed


def test_status_tells_what_runs_and_what_a_killed_stage_left(tmp_path: Path, cli: Cli) -> None:
    run = tmp_path / "sphere.vorolight"
    assert cli("init", "sphere", "-n", 6, "--iterations", 2, cwd=tmp_path).returncode == 0
    place = run / "checkpoints" / "sphere-train" / ("a" * 16)
    place.mkdir(parents=True)
    (place / "000040.h5").touch()
    step = {"event": "progress", "label": "sphere-train", "done": 40, "of": 200}
    lines = [{"event": "start", "pid": os.getpid()}, {"pid": os.getpid(), **step}]
    log = "".join(json.dumps(line) + "\n" for line in lines)
    (run / "logs" / "sphere-train.jsonl").write_text(log)

    def told() -> dict[str, Any]:
        seen = cli("status", "--json", cwd=tmp_path)
        assert seen.returncode == 0, seen.stderr
        return {entry["stage"]: entry for entry in map(json.loads, seen.stdout.splitlines())}

    assert told()["sphere-train"]["state"] == "to do"
    (run / ".lock").write_text(json.dumps({"host": os.uname().nodename, "pid": os.getpid()}))
    entry = told()["sphere-train"]
    assert entry["state"] == "running"
    assert entry["progress"] == "sphere-train: 40 of 200"
    assert entry["checkpoint"] == 40
    assert entry["holder"]["pid"] == os.getpid()
    assert told()["init"]["state"] == "done"
    assert "40 of 200" in cli("status", cwd=tmp_path).stdout


def test_status_verifies_the_contents(tmp_path: Path, cli: Cli) -> None:
    assert cli("init", "sphere", "-n", 6, "--iterations", 2, cwd=tmp_path).returncode == 0
    path = tmp_path / "sphere.vorolight" / "init.ply"
    times, data = path.stat(), bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # as a disk that forgets would
    assert cli("status", cwd=tmp_path).returncode == 0
    done = cli("status", "--verify", cwd=tmp_path)
    assert done.returncode == 4
    assert "init.ply changed" in done.stderr
    again = cli("init", "--iterations", 2, "--verify", "--json", cwd=tmp_path)
    assert again.returncode == 0
    assert cli("status", "--verify", cwd=tmp_path).returncode == 0


def test_a_log_tells_what_a_stage_did(heart_run: Path) -> None:
    lines = (heart_run / "logs" / "sphere-train.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    assert [events[0]["event"], events[-1]["event"]] == ["start", "done"]
    assert events[0]["command"].startswith("vorolight sphere-train")
    steps = [event for event in events if event["event"] == "progress"]
    assert steps[-1]["done"] == steps[-1]["of"]


def test_names_cannot_write_to_the_terminal(tmp_path: Path, cli: Cli) -> None:
    done = cli("init", "evil\x1b[31m\nname.obj", cwd=tmp_path)
    assert done.returncode == 3
    assert "\x1b" not in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "evil\\x1b[31m\\nname.obj" in done.stderr
