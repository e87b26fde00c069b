"""Run folders: atomic writes, locks, checkpoints, layouts, manifests."""

from __future__ import annotations

import copy
import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vorolight import schemas
from vorolight.schemas import layouts
from vorolight.stages import memory
from vorolight.stages.artifacts import (
    atomic,
    fingerprint,
    hdf5,
    lock,
    log,
    manifest,
    processes,
    randomness,
    requeue,
)  # fmt: skip
from vorolight.stages.artifacts.checkpoints import Checkpoints
from vorolight.stages.artifacts.manifest import read as read_manifest
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.errors import ArtifactError, Locked, Stopped, UsageError
from vorolight.stages.progress import Silent


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "a.json"
    atomic.write(path, b"old")

    def broken(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(UsageError, match="No space left"):
        atomic.write(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_sweep_removes_only_what_dead_processes_left(tmp_path: Path) -> None:
    dead, alive = tmp_path / ".x.h5.tmp.999999999", tmp_path / f".y.h5.tmp.{os.getpid()}"
    dead.touch()
    alive.touch()
    atomic.sweep(tmp_path)
    assert not dead.exists()
    assert alive.exists()


def test_lock(tmp_path: Path) -> None:
    with lock.locked(tmp_path) as notes:
        assert notes == []
        with pytest.raises(Locked, match="works on this run folder"), lock.locked(tmp_path):
            pass
    assert not (tmp_path / lock.NAME).exists()
    mine = {"host": os.uname().nodename, "pid": os.getpid()}
    assert lock.holder(tmp_path) is None
    other = mine | {"pid": os.getppid(), "start": processes.start_of(os.getppid())}
    (tmp_path / lock.NAME).write_text(json.dumps(other))
    assert lock.holder(tmp_path)["pid"] == os.getppid()
    with pytest.raises(Locked, match="works on this run folder"), lock.locked(tmp_path):
        pass
    # Its number has gone to another process since.
    (tmp_path / lock.NAME).write_text(json.dumps(other | {"start": "an earlier one"}))
    assert lock.holder(tmp_path) is None
    with lock.locked(tmp_path) as notes:
        assert "took over" in notes[0]
    dead = json.dumps(mine | {"pid": 999999999, "start": 0})
    (tmp_path / lock.NAME).write_text(dead)
    with lock.locked(tmp_path) as notes:
        assert "took over" in notes[0]
    reborn = json.dumps(mine | {"start": 0})
    (tmp_path / lock.NAME).write_text(reborn)  # a container gave us our predecessor's number
    with lock.locked(tmp_path) as notes:
        assert "took over" in notes[0]
    assert list(tmp_path.iterdir()) == []
    (tmp_path / lock.NAME).write_text(json.dumps({"host": "elsewhere", "pid": 1, "start": 0}))
    with pytest.raises(Locked, match="elsewhere"), lock.locked(tmp_path):
        pass


def test_a_job_that_is_started_again_takes_its_lock_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLURM_JOB_ID", "17")
    there = {"host": "another node", "pid": 1, "start": 0}
    for job, taken in ((":17", True), (":18", False), (None, False)):
        (tmp_path / lock.NAME).write_text(json.dumps(there | {"job": job}))
        if taken:
            with lock.locked(tmp_path) as notes:
                assert "took over" in notes[0]
        else:
            with pytest.raises(Locked, match="another node"), lock.locked(tmp_path):
                pass


def test_locks_where_there_are_no_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    with (
        lock.locked(tmp_path),
        pytest.raises(Locked, match="works on this run folder"),
        lock.locked(tmp_path),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_checkpoints_cost_little_and_end_a_process_that_was_asked_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    mine = Checkpoints(
        tmp_path / "init", "a" * 64, lambda event, **facts: told.append((event, facts))
    )
    mine.save(1, lambda: {"x": np.zeros(3)})
    mine.save(2, lambda: {"x": np.zeros(3)})  # too soon: it would cost more than two percent
    assert mine.latest()[0] == 1
    monkeypatch.setattr(requeue, "_asked", True)
    with pytest.raises(Stopped, match="continues from there"):
        mine.save(3, lambda: {"x": np.zeros(3)})
    assert mine.latest()[0] == 3
    assert [event for event, _ in told] == ["checkpoint", "resumed", "checkpoint", "resumed"]


def test_touch_is_never_before_the_parents(tmp_path: Path) -> None:
    parent, child = tmp_path / "parent", tmp_path / "child"
    parent.touch()
    child.touch()
    future = 2**32 * 10**9  # the clock was set back since
    os.utime(parent, ns=(future, future))
    atomic.touch(child, [parent])
    assert child.stat().st_mtime_ns == future
    atomic.touch(child)
    assert child.stat().st_mtime_ns < future


def test_logs_go_on_after_a_torn_line(tmp_path: Path) -> None:
    for number in range(2):
        told = log.StageLog(tmp_path, "init", Silent())
        told.event("start", number=number)
        told.start("init", 1000)
        for done in range(1000):
            told.advance(done)
        told.close()
        with open(tmp_path / "logs" / "init.jsonl", "a") as stream:
            stream.write('{"event": "torn')
    events = log.read(tmp_path, "init")
    assert [event["number"] for event in events if event["event"] == "start"] == [0, 1]
    assert sum(event["event"] == "progress" for event in events) == 20  # one a tenth
    assert {type(event["time"]) for event in events} == {str}


def test_checkpoints(tmp_path: Path) -> None:
    mine = Checkpoints(tmp_path / "checkpoints" / "init", "a" * 64)
    assert mine.latest() is None
    for iteration in (10, 20, 30):
        mine.save(iteration, lambda iteration=iteration: {"x": np.full(3, iteration)})
        mine._cost = 0.0  # the next one is due at once
    assert len(list(mine.folder.iterdir())) == 2
    assert mine.latest()[0] == 30
    (mine.folder / "000030.h5").write_bytes(b"torn")
    iteration, arrays = mine.latest()
    assert iteration == 20
    kept = mine.folder / "000020.h5"
    whole = kept.read_bytes()
    place = whole.index(np.full(3, 20).tobytes())
    kept.write_bytes(whole[:place] + b"\x15" + whole[place + 1 :])  # 21 for 20: still an HDF5 file
    assert mine.latest() is None
    kept.write_bytes(whole)
    assert arrays["x"].tolist() == [20, 20, 20]
    other = Checkpoints(mine.folder.parent, "b" * 64)
    assert other.latest() is None
    other.save(10, lambda: {"x": np.zeros(3)})
    assert other.latest()[0] == 10  # the later ones of a run with other options do not push it out
    mine.clear()
    assert list(tmp_path.iterdir()) == []


def test_hdf5_bytes_are_reproducible_and_laid_out(tmp_path: Path) -> None:
    arrays = {
        "origin": np.zeros(3),
        "spacing": 0.1,
        "interior": np.zeros((9, 8, 7), bool),
        "exterior": np.zeros((9, 8, 7), bool),
    }
    data = hdf5.encode("classify", arrays, {"stage": "classify"})
    assert data == hdf5.encode("classify", arrays, {"stage": "classify"})
    path = tmp_path / "classify.h5"
    path.write_bytes(data)
    found, attributes = hdf5.read(path, "classify")
    assert found["interior"].shape == (9, 8, 7)
    assert attributes["stage"] == "classify"
    with pytest.raises(ValueError, match="shape"):
        hdf5.encode("classify", arrays | {"exterior": np.zeros((9, 8, 6), bool)}, {})
    for cut in (0, 10, len(data) // 2):
        path.write_bytes(data[:cut])
        with pytest.raises(ArtifactError, match="--force"):
            hdf5.read(path, "classify")


def test_layout_names_the_fault() -> None:
    good = {
        "vertices": np.zeros((3, 3)),
        "face_offsets": np.array([0, 3]),
        "face_vertices": np.arange(3),
    }
    arrays = {f"surface/{key}": value for key, value in good.items()}
    arrays |= {"vertex_distance": np.zeros(3), "mean_curvature": np.zeros(3)}
    layouts.check("evaluate", arrays)
    for change, reason in (
        ({"surface/face_vertices": np.array([0, 1, 3])}, "not there"),
        ({"surface/face_offsets": np.array([0, 2])}, "row index"),
        ({"vertex_distance": np.zeros(4)}, "shape"),
        ({"vertex_distance": np.zeros(3, int)}, "holds int64"),
    ):
        with pytest.raises(ValueError, match=reason):
            layouts.check("evaluate", arrays | change)


def test_randomness_is_counter_based() -> None:
    first = randomness.generator(1, "init", "target", 5).random(4)
    assert np.array_equal(first, randomness.generator(1, "init", "target", 5).random(4))
    for other in ((2, "init", "target", 5), (1, "volume", "target", 5), (1, "init", "target", 6)):
        assert not np.array_equal(first, randomness.generator(*other).random(4))


def test_manifests_are_checked(manifest: Callable[[str], dict[str, Any]], tmp_path: Path) -> None:
    good = manifest("init")
    schemas.validate(good)
    schemas.validate(good | {"unknown": 1})
    for path, value in (
        (("fingerprint",), "short"),
        (("params", "iterations"), "many"),
        (("params", "iterations"), -1),
        (("outputs", 0, "path"), "../elsewhere.h5"),
        (("outputs", 0, "path"), ".."),
        (("stage",), "volume"),
    ):
        bad = copy.deepcopy(good)
        place: Any = bad
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        with pytest.raises(ValueError, match="breaks its schema"):
            schemas.validate(bad)
    path = tmp_path / "init.json"
    path.write_text(json.dumps(good))
    assert read_manifest(path) == good
    for part in (good["metrics"], good["volatile"]["mtime_ns"]):
        part["another"] = 12345
        path.write_text(json.dumps(good))
        with pytest.raises(ArtifactError, match="was changed after it was written"):
            read_manifest(path)
        del part["another"]
    (tmp_path / "classify.json").write_text(json.dumps(good))
    with pytest.raises(ArtifactError, match="belongs to another stage"):
        read_manifest(tmp_path / "classify.json")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "init.json").symlink_to(path)
    with pytest.raises(ArtifactError, match="leads out of this folder"):
        read_manifest(elsewhere / "init.json")
    for text in ("[" * 100_000, '{"a": NaN}', '{"a": 1e999}', "", "[]", "{}"):
        path.write_text(text)
        with pytest.raises(ArtifactError, match=r"init\.json"):
            read_manifest(path)
    newer = good | {"schema": "urn:vorolight:manifest:99:init"}
    with pytest.raises(ValueError, match="upgrade"):
        schemas.validate(newer)


def test_numbers_that_json_lacks_become_null() -> None:
    cleaned = manifest.clean_numbers({"a": np.float64("nan"), "b": [np.int64(3), float("inf")]})
    assert cleaned == {"a": None, "b": [3, None]}


def test_fingerprints_do_not_depend_on_order() -> None:
    assert fingerprint.of_json({"a": 1, "b": 2.0}) == fingerprint.of_json({"b": 2.0, "a": 1})
    assert fingerprint.of_json({"a": 1}) != fingerprint.of_json({"a": 2})


def test_run_folder_is_found(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no run folder here"):
        RunFolder.locate(None, None, tmp_path)
    assert RunFolder.locate(None, "bunny", tmp_path).path == tmp_path / "bunny.vorolight"
    one = tmp_path / "one.vorolight"
    one.mkdir()
    assert RunFolder.locate(None, None, tmp_path).path == one
    assert RunFolder.locate(None, None, one).path == one
    (tmp_path / "two.vorolight").mkdir()
    with pytest.raises(UsageError, match=r"one.vorolight, two.vorolight"):
        RunFolder.locate(None, None, tmp_path)


def test_a_container_may_have_less_memory_than_its_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = memory.free_mb()
    assert whole > 100
    monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path)
    assert memory.free_mb() == pytest.approx(whole, rel=0.5)  # others use memory too
    (tmp_path / "memory.current").write_text("20000000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.free_mb() > 100
    (tmp_path / "memory.max").write_text("70000000\n")
    assert memory.free_mb() == 50.0
    memory.require("init", 49.0, None)
    with pytest.raises(
        UsageError, match=r"init: needs about 0\.1 GB of memory, but only 0\.1 GB are free"
    ):
        memory.require("init", 100.0, None)
