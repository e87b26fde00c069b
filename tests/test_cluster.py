"""Many shapes at once: lists of them, the script for Slurm, the Snakemake workflow."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import Cli, sphere_mesh, write_ply

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import ways

from vorolight.stages.errors import InputError
from vorolight.stages.inputs import shape_list

needs_bash = pytest.mark.skipif(os.name == "nt", reason="Slurm runs on systems that have bash")
ODD = 'my "odd" sh\'ape $(x).ply'


def listed(folder: Path, *lines: str) -> Path:
    path = folder / "shapes.txt"
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def test_a_list_is_read_without_its_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path(ODD), *sphere_mesh(level=1))
    (tmp_path / "dots.xyz").write_text("0 0 0\n")
    found = shape_list.read(listed(tmp_path, "# some", "", ODD, "  heart ", "dots.xyz"))
    assert [(s.input, s.kind, s.stem, s.line) for s in found] == [
        (ODD, "mesh", ODD.removesuffix(".ply"), 3),
        ("heart", "field", "heart", 4),
        ("dots.xyz", "points", "dots", 5),
    ]
    assert [s.path for s in found] == [Path(ODD), None, Path("dots.xyz")]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "has no shape"),
        (["# nothing", ""], "has no shape"),
        (["sphere", "gone.ply"], "line 2: gone.ply: no such file"),
        (["sphere", "# x", "two words"], "line 3: two words: no such file"),
        (["sphere", "heart", "other/sphere.ply"], "line 3: other/sphere.ply would share the run"),
        (["other"], "line 1: other: is a folder without cameras"),
    ],
)
def test_bad_lists(
    lines: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    write_ply(tmp_path / "other" / "sphere.ply", *sphere_mesh(level=1))
    with pytest.raises(InputError, match=said) as caught:
        shape_list.read(listed(tmp_path, *lines))
    assert str(caught.value).startswith(f"{tmp_path / 'shapes.txt'}")


def test_sbatch_refuses_in_one_sentence(tmp_path: Path, cli: Cli) -> None:
    listed(tmp_path, "sphere", "sphere")
    (tmp_path / "bad.toml").write_text("[init]\nnonsense = 1\n")
    (tmp_path / "good.txt").write_text("sphere\n")
    empty = {"PATH": str(tmp_path)}
    for words, code, said in (
        (["shapes.txt"], 3, "shapes.txt, line 2: sphere would share"),
        (["none.txt"], 3, "none.txt: no such file"),
        (["good.txt", "--until", "dinner"], 2, "--until dinner: must be one of"),
        (["good.txt", "--config", "bad.toml"], 2, "[init] nonsense: no such option"),
        (["good.txt", "--submit"], 69, "sbatch is not installed"),
    ):
        done = cli("sbatch", *words, cwd=tmp_path, env=empty)
        assert done.returncode == code, done.stderr
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
        assert done.stdout == ""


# Each takes what it is called with down. sbatch runs nothing; it numbers the jobs.
FAKES = {
    "sbatch": 'n=$(($(cat n 2> /dev/null || echo 100) + 1)); echo $n > n; echo "$n;one"\n'
    '[ "${FULL-}" != $n ] || { echo "sbatch: error: the queue is full" >&2; exit 1; }',
    "scontrol": ":",
    "scancel": ":",
}


@pytest.fixture
def cluster(tmp_path: Path) -> Path:
    """A folder with a list and commands that stand for Slurm's, in its folder bin."""
    folder = tmp_path / "it's a place"
    (folder / "bin").mkdir(parents=True)
    for name, body in FAKES.items():
        path = folder / "bin" / name
        path.write_text(f'#!/bin/bash\nprintf "%s|" {name} "$@" >> calls; echo >> calls\n{body}\n')
        path.chmod(0o755)
    write_ply(folder / ODD, *sphere_mesh(level=1))
    listed(folder, "# shapes", "sphere", ODD, "heart")
    return folder


def on_path(folder: Path) -> dict[str, str]:
    return {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"}


def calls(folder: Path) -> list[list[str]]:
    path = folder / "calls"
    return [line.split("|")[:-1] for line in path.read_text().splitlines()] if path.exists() else []


@needs_bash
def test_arrays_form_chains(cluster: Path, cli: Cli) -> None:
    words = ["--until", "sphere-train", "--array-size", 2, "--at-once", 1, "--threads", 3]
    asked = ["--memory", "3G", "--time", "1:00:00", "--partition", "a b", "--account", "x"]
    printed = cli("sbatch", "shapes.txt", *words, *asked, cwd=cluster)
    assert printed.returncode == 0, printed.stderr
    assert not (cluster / "slurm-logs").exists()
    script = cluster.parent / "submit.sh"
    script.write_text(printed.stdout)
    subprocess.run(["bash", "-n", script], check=True)
    # From anywhere: the script knows its folder.
    subprocess.run(
        ["bash", script], check=True, cwd="/", env={**os.environ, **on_path(cluster)}, timeout=60
    )
    (logs,) = (cluster / "slurm-logs").iterdir()
    assert (logs / "inputs.txt").read_text() == f"sphere\n{ODD}\nheart\n"
    runs = (logs / "runs.txt").read_text().splitlines()
    assert runs == ["sphere.vorolight", f"{ODD.removesuffix('.ply')}.vorolight", "heart.vorolight"]
    made = calls(cluster)
    stages = ["classify", "init", "sphere-train"]
    assert [call[-2] for call in made] == stages * 2
    assert [call[-1] for call in made] == ["0"] * 3 + ["2"] * 3
    for k, call in enumerate(made):
        assert {"--cpus-per-task=3", "--mem=3G", "--time=1:00:00", "--partition=a b"} <= set(call)
        assert {"--account=x", "--requeue", "--open-mode=append"} <= set(call)
        assert {"--signal=B:USR1@120", f"--array={'1-2' if k < 3 else '1-1'}%1"} <= set(call)
        follows = [word for word in call if word.startswith("--dependency")]
        assert follows == ([] if k % 3 == 0 else [f"--dependency=aftercorr:{100 + k}"])
        assert ("--kill-on-invalid-dep=yes" in call) == bool(follows)


@needs_bash
def test_a_full_queue_takes_whole_parts(cluster: Path, cli: Cli) -> None:
    words = ["sbatch", "shapes.txt", "--until", "init", "--array-size", 2, "--submit"]
    done = cli(*words, cwd=cluster, env={**on_path(cluster), "FULL": "104"})
    assert done.returncode == 2
    assert "init: job 102" in done.stdout
    assert "the queue is full" in done.stderr
    assert calls(cluster)[-1] == ["scancel", "103"]
    (script,) = cluster.glob("slurm-logs/*/submit.sh")
    assert f"go on with: bash {script.relative_to(cluster)} 3" in done.stderr
    env = {**os.environ, **on_path(cluster)}
    command = ["bash", script, "3"]
    again = subprocess.run(command, cwd=cluster, env=env, text=True, capture_output=True)
    assert again.returncode == 0, again.stderr
    assert [call[-2:] for call in calls(cluster)[-2:]] == [["classify", "2"], ["init", "2"]]


# The job's command in place of vorolight's: what the first argument after the module says.
STANDIN = """\
#!/bin/bash
printf '%s|' run "$@" >> calls; echo >> calls
trap 'echo stopping; exit 85' USR1
trap 'exit 143' TERM
touch begun
[ ! -e code ] || exit "$(cat code)"
for _ in $(seq 300); do sleep 0.1; done
"""


def job(cluster: Path, stage: str, task: int, **more: object) -> subprocess.Popen[str]:
    """The job script of the only submission, as Slurm starts it."""
    (logs,) = (cluster / "slurm-logs").iterdir()
    place = logs.relative_to(cluster)
    numbers = {"SLURM_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": str(task)}
    return subprocess.Popen(
        ["bash", place / "job.sh", place, stage, "0"],
        cwd=cluster,
        env={**os.environ, **on_path(cluster), **numbers},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.fixture
def stand_in(cluster: Path, cli: Cli) -> Path:
    """A submission whose jobs run a command that does nothing until it gets a signal."""
    done = cli("sbatch", "shapes.txt", "-n", 6, "--submit", cwd=cluster, env=on_path(cluster))
    assert done.returncode == 0, done.stderr
    (script,) = cluster.glob("slurm-logs/*/job.sh")
    command = cluster / "bin" / "stand-in"
    command.write_text(STANDIN)
    command.chmod(0o755)
    text = script.read_text()
    line = next(line for line in text.splitlines() if "-m vorolight.cli" in line)
    script.write_text(text.replace(line.split(" -m ")[0], "bin/stand-in"))
    (cluster / "calls").unlink()
    return cluster


@needs_bash
@pytest.mark.parametrize(
    ("number", "code", "requeued"),
    [(signal.SIGUSR1, 85, True), (signal.SIGTERM, 143, False)],
    ids=["USR1", "TERM"],
)
def test_a_job_forwards_signals(
    number: signal.Signals, code: int, requeued: bool, stand_in: Path
) -> None:
    running = job(stand_in, "init", 2)
    deadline = time.monotonic() + 30
    while not (stand_in / "begun").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    running.send_signal(number)
    output = running.communicate(timeout=60)[0]
    assert running.returncode == code, output
    assert (["scontrol", "requeue", "7"] in calls(stand_in)) == requeued


@needs_bash
@pytest.mark.parametrize("code", [0, 3, 75, 85, 127, 138])
def test_a_job_ends_with_the_code_of_its_stage(code: int, stand_in: Path) -> None:
    (stand_in / "code").write_text(str(code))
    running = job(stand_in, "classify", 2)
    running.communicate(timeout=60)
    assert running.returncode == code
    (ran, *rest) = calls(stand_in)
    run = f"{ODD.removesuffix('.ply')}.vorolight"
    assert ran[:6] == ["run", "-m", "vorolight.cli", "classify", "--run", run]
    assert ran[-4:] == ["-n", "6", "--", ODD]
    assert rest == ([["scontrol", "requeue", "7"]] if code in (85, 138) else [])


@needs_bash
def test_a_job_runs_its_stage(cluster: Path, cli: Cli) -> None:
    listed(cluster, ODD)
    (cluster / "options.toml").write_text(ways.OPTIONS)
    words = ["--config", "options.toml", "--until", "classify", "--runs", "runs", "--submit"]
    assert cli("sbatch", "shapes.txt", *words, cwd=cluster, env=on_path(cluster)).returncode == 0
    # What the jobs read are copies.
    (cluster / "options.toml").write_text("[classify]\nn-init = 7\n")
    listed(cluster, "heart")
    running = job(cluster, "classify", 1)
    output = running.communicate(timeout=120)[0]
    assert running.returncode == 0, output
    run = cluster / "runs" / f"{ODD.removesuffix('.ply')}.vorolight"
    direct = ways.copied(cluster, cluster.parent / "direct")
    listed(direct, "# INPUTs", ODD)
    (direct / "options.toml").write_text(ways.OPTIONS)
    ways.directly(direct, ["classify"])
    assert set(ways.results(run)) >= {"classify.json", "classify.h5"}
    assert ways.results(run) == ways.results(direct / "runs" / run.name)


snakemake = pytest.mark.skipif(os.name == "nt", reason="the extra cluster is not for Windows")


@snakemake
def test_snakemake_makes_what_the_commands_make(tmp_path: Path) -> None:
    reference = ways.prepare(tmp_path / "reference", 3)
    shapes = ways.shapes(reference)
    for place in (reference, ways.copied(reference, tmp_path / "snakemake")):
        (place / "shapes.txt").write_text("# INPUTs\n" + "\n".join(shapes[1:]) + "\n")
    ways.directly(reference, ways.STAGES[:2])
    place = tmp_path / "snakemake"
    targets = [f"runs/{Path(shape).stem}.vorolight/init.json" for shape in shapes[1:]]
    said = ways.by_snakemake(place, *targets)
    assert "4 of 4 steps" in said
    assert ways.differences(reference, place) == []
    manifests = sorted(place.glob("runs/*/*.json"))
    assert len(manifests) == 4
    before = [path.read_bytes() for path in manifests]
    assert "Nothing to be done" in ways.by_snakemake(place, *targets)
    # A changed file of options has every stage asked; what stands is touched, and made by nobody.
    with (place / "options.toml").open("a") as options:
        options.write("# another remark\n")
    times = [path.stat().st_mtime_ns for path in manifests]
    ways.by_snakemake(place, *targets)
    assert [path.read_bytes() for path in manifests] == before
    assert all(p.stat().st_mtime_ns > t for p, t in zip(manifests, times, strict=True))
    assert "Nothing to be done" in ways.by_snakemake(place, *targets)


@snakemake
def test_snakemake_refuses_shapes_of_one_name(tmp_path: Path) -> None:
    place = ways.prepare(tmp_path / "place", 3)
    shutil.copy(place / "shape0.ply", place / "heart.ply")
    listed(place, "heart", "heart.ply")
    with pytest.raises(ways.Failed, match=r"line 2: heart\.ply would share the run"):
        ways.by_snakemake(place, "-n")


@snakemake
@pytest.mark.slow
def test_a_thousand_shapes_are_planned_in_a_minute(tmp_path: Path, cli: Cli) -> None:
    place = ways.prepare(tmp_path / "place", 3)
    first = (place / "shape0.ply").read_bytes()
    (place / "many").mkdir()
    names = [f"many/{k:05d}.ply" for k in range(10_000)]
    for name in names:
        (place / name).write_bytes(first)
    listed(place, "# INPUTs", *names[:1000])
    began = time.perf_counter()
    said = ways.by_snakemake(place, "-n")
    assert "6002" in said  # six stages each, the table, and all of it
    assert time.perf_counter() - began < 60
    listed(place, *names)
    began = time.perf_counter()
    done = cli("sbatch", "shapes.txt", cwd=place)
    assert done.stdout.count("\n    submit ") == 60
    assert time.perf_counter() - began < 60
