"""On a real Slurm, by `make test-slurm`: the one that answers, or one of a node started as root."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from conftest import sphere_mesh, write_ply

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import ways

pytestmark = [pytest.mark.slurm, pytest.mark.timeout(1800)]
SCRIPT = Path(__file__).parent / "slurm" / "one-node.sh"
TRAINING = '[init]\niterations = 5\n[sphere-train]\niterations = 300\nfaces = "polygon"\n'


@pytest.fixture(scope="module", autouse=True)
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The Slurm that answers, or one of our own; without any these tests fail, not skip."""
    if ways.slurm_answers():
        yield
        return
    folder = tmp_path_factory.mktemp("slurm")
    ways.call(SCRIPT, "start", folder, cwd=folder)
    try:
        yield
    finally:
        ways.call(SCRIPT, "stop", folder, cwd=folder)


def submitted(folder: Path, *words: object) -> dict[str, str]:
    """The number of the job of each stage."""
    command = [sys.executable, "-m", "vorolight.cli", "sbatch", "shapes.txt", "--runs", "runs"]
    said = ways.call(*command, "--config", "options.toml", "--submit", *words, cwd=folder)
    return dict(re.findall(r"^([\w-]+): job (\d+),", said, flags=re.MULTILINE))


def shown(job: str, name: str) -> str:
    """A field of what Slurm says of a job."""
    said = ways.call("scontrol", "show", "job", job, cwd=SCRIPT.parent)
    return re.findall(rf"\b{name}=(\S+)", said)[0]


def awaited(what: str, holds: Callable[[], object], seconds: float = 300) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        time.sleep(0.05)


def test_every_way_gives_the_same_bytes(tmp_path: Path) -> None:
    reference = ways.prepare(tmp_path / "reference", 8)
    ways.directly(reference)
    for name in ("vorolight sbatch", "snakemake on Slurm"):
        place = ways.copied(reference, tmp_path / name.replace(" ", "-"))
        ways.WAYS[name](place)
        assert ways.differences(reference, place) == [], name


def test_a_shape_that_fails_takes_only_its_own_jobs_along(tmp_path: Path) -> None:
    write_ply(tmp_path / "good.ply", *sphere_mesh(level=1))
    (tmp_path / "bad.obj").write_text("nothing of a mesh\n")
    (tmp_path / "shapes.txt").write_text("bad.obj\ngood.ply\n")
    (tmp_path / "options.toml").write_text(ways.OPTIONS)
    jobs = submitted(tmp_path, "--until", "init")
    ways.wait_for_queue(300)
    assert (tmp_path / "runs" / "good.vorolight" / "init.json").exists()
    assert not (tmp_path / "runs" / "bad.vorolight").exists()
    assert shown(f"{jobs['classify']}_1", "ExitCode") == "3:0"
    (log,) = tmp_path.glob(f"slurm-logs/*/vorolight-classify-{jobs['classify']}_1.out")
    assert "vorolight: bad.obj: has 0 vertices" in log.read_text()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One shape, trained without disturbance."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "shapes.txt").write_text("# INPUT\nsphere\n")
    (folder / "options.toml").write_text(f"[classify]\nn-init = 8\n{TRAINING}")
    ways.directly(folder, ways.STAGES[:3])
    return folder


def in_training(folder: Path) -> str:
    """Submit the shape; the job that trains it, once it has left a checkpoint."""
    job = f"{submitted(folder, '--until', 'sphere-train')['sphere-train']}_1"
    run = folder / "runs" / "sphere.vorolight"
    awaited("a checkpoint", lambda: list(run.glob("checkpoints/sphere-train/*/*.h5")))
    assert shown(job, "JobState") == "RUNNING"
    return job


def finished(folder: Path, job: str, restarts: int) -> None:
    """See a job that was queued again to its end. Slurm first lets the credentials of its last
    start expire, two minutes by default."""
    awaited("the job is queued again", lambda: shown(job, "JobState") == "PENDING")
    assert not (folder / "runs" / "sphere.vorolight" / "sphere-train.json").exists()
    assert shown(job, "Restarts") == str(restarts)
    awaited("it has ended", lambda: shown(job, "JobState") in ("COMPLETED", "FAILED"), 600)
    assert shown(job, "ExitCode") == "0:0"


def test_sigusr1_ends_at_a_checkpoint_and_the_job_goes_on(trained: Path, tmp_path: Path) -> None:
    place = ways.copied(trained, tmp_path / "asked")
    job = in_training(place)
    ways.call("scancel", "--batch", "--signal=USR1", job, cwd=place)
    finished(place, job, 1)
    (log,) = place.glob(f"slurm-logs/*/vorolight-sphere-train-{job}.out")
    assert log.read_text().count("stopped at a checkpoint") == 1
    assert ways.differences(trained, place) == []


@pytest.mark.parametrize("whole", [False, True], ids=["stage", "job"])
def test_a_killed_job_that_is_queued_again_goes_on(
    whole: bool, trained: Path, tmp_path: Path
) -> None:
    place = ways.copied(trained, tmp_path / "killed")
    job = in_training(place)
    lock = place / "runs" / "sphere.vorolight" / ".lock"
    stage = psutil.Process(json.loads(lock.read_text())["pid"])
    # With its script too, as when a node dies, nobody is left to say how the stage ended.
    for process in [stage.parent(), stage] if whole else [stage]:
        process.kill()
    awaited("the job has ended", lambda: shown(job, "JobState") in ("FAILED", "CANCELLED"))
    assert lock.exists()
    ways.call("scontrol", "requeue", job, cwd=place)
    finished(place, job, 1)
    assert not lock.exists()
    assert ways.differences(trained, place) == []
