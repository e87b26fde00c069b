"""The script that submits a list of shapes to Slurm: plain bash, meant to be read before it
runs."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

LOGS = "slurm-logs"


@dataclass(frozen=True)
class Plan:
    """The content of the script. Shapes are counted from 1, as lines are."""

    name: str
    folder: Path
    """The folder that relative paths refer to, and in which the jobs run."""
    python: str
    inputs: tuple[str, ...]
    runs: tuple[str, ...]
    stages: tuple[str, ...]
    """The stages in order. They share a run folder and its lock, so each waits for the one before
    it."""
    last: tuple[str, tuple[int, ...]] | None
    """A stage that only some of the shapes take, after all others."""
    resolution: int | None
    config: str | None
    threads: int
    asked: Mapping[str, str]
    """Options of sbatch, by name."""
    at_once: int | None
    array_size: int


SUBMIT = """\
#!/usr/bin/env bash
# {count} shapes, one array of jobs a stage: each task of an array waits for the same task of the
# array before it, and goes with it if that fails. Run this where sbatch is; with a number, it
# submits the shapes from there on.
set -euo pipefail
cd -- {folder}
from=${{1:-1}}
logs={logs}
mkdir -p -- "$logs"

# What the tasks read: copies, so that later edits of the originals change no job that waits. The
# folder is called after their content; one that is there already is the same.
keep() {{
    [ -e "$logs/$1" ] || {{ cat > "$logs/$1.$$" && mv -- "$logs/$1.$$" "$logs/$1"; }}
}}
keep inputs.txt <<'{end}'
{inputs}{end}
keep runs.txt <<'{end}'
{runs}{end}
keep options.toml <<'{end}'
{config}{end}
keep job.sh <<'{end}'
{job}{end}

# A queue may hold only so many jobs (MaxJobCount, MaxSubmitJobs): each part is in it or is not.
offset=0 id= ids=()
withdraw() {{
    [ ${{#ids[@]}} -eq 0 ] || scancel "${{ids[@]}}"
    echo "The shapes from $((offset + 1)) on are not submitted. When the queue has room for" \\
        "{stages} jobs more, go on with: bash $0 $((offset + 1))" >&2
}}
trap '[ $? -eq 0 ] || withdraw' EXIT

part() {{
    offset=$1 id= ids=()
    [ $((offset + 1)) -ge "$from" ]
}}
submit() {{ # STAGE TASKS
    id=$(sbatch --parsable --job-name="vorolight-$1" --array="$2{throttle}" \\
        ${{id:+--dependency="aftercorr:$id" --kill-on-invalid-dep=yes}} \\
        --cpus-per-task={threads} --signal=B:USR1@120 --requeue --open-mode=append \\
        --output="$logs/%x-%A_%a.out"{asked} "$logs/job.sh" "$logs" "$1" "$offset")
    id=${{id%%;*}}
    ids+=("$id")
    echo "$1: job $id, tasks $2, of the shapes from $((offset + 1)) on"
}}

{calls}
echo "Logs: $logs"
"""

JOB = """\
#!/usr/bin/env bash
# One stage of one shape: job.sh LOGS STAGE OFFSET, for the line OFFSET + task of the lists.
logs=$1 stage=$2 line=$(($3 + SLURM_ARRAY_TASK_ID))
run=$(sed -n "${{line}}p" -- "$logs/runs.txt")
words=(--run "$run" --threads {threads} --config "$logs/options.toml")
case $stage in classify | init) words+=({resolution}) ;; esac
[ "$stage" != classify ] || words+=(-- "$(sed -n "${{line}}p" -- "$logs/inputs.txt")")

# bash handles a signal only between commands, or in wait: so the stage runs in the background.
child= signalled=
forward() {{ signalled=$1; [ -z "$child" ] || kill -s "$1" "$child" 2> /dev/null; }}
trap 'forward USR1' USR1
trap 'forward TERM' TERM
{python} -m vorolight.cli "$stage" "${{words[@]}}" &
child=$!
[ -z "$signalled" ] || kill -s "$signalled" "$child"
while
    signalled=
    wait "$child"
    found=$?
    # 127: the stage had ended before the signal came, and was waited for.
    [ $found -eq 127 ] && [ -n "${{code-}}" ] || code=$found
    [ -n "$signalled" ]
do :; done

# 85: stopped at a checkpoint. 138: SIGUSR1 came before the stage had begun.
if [ $code -eq 85 ] || [ $code -eq 138 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit $code
"""


def script(plan: Plan) -> tuple[str, str]:
    """The script for ``plan``, which writes what the jobs read, and submits them; and the folder
    of its logs."""
    job = JOB.format(
        threads=plan.threads,
        resolution="" if plan.resolution is None else f"-n {plan.resolution}",
        python=shlex.quote(plan.python),
    )
    config = (plan.config or "").splitlines()
    texts = [_lines(plan.inputs), _lines(plan.runs), _lines(config), job]
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()[:8]
    # Slurm reads % in the names of logs.
    name = re.sub(r"[^\w.-]", "_", plan.name, flags=re.ASCII)
    logs = f"{LOGS}/{name}-{digest}"
    text = SUBMIT.format(
        count=len(plan.inputs),
        folder=shlex.quote(str(plan.folder)),
        logs=logs,
        end=f"END-{digest}",
        **dict(zip(("inputs", "runs", "config", "job"), texts, strict=True)),
        throttle=f"%{plan.at_once}" if plan.at_once else "",
        threads=plan.threads,
        asked="".join(f" \\\n        --{k}={shlex.quote(v)}" for k, v in plan.asked.items()),
        stages=min(len(plan.inputs), plan.array_size) * (len(plan.stages) + bool(plan.last)),
        calls="\n".join(_calls(plan)),
    )
    return text, logs


def _calls(plan: Plan) -> Iterator[str]:
    """One call of ``submit`` for each stage, for as many shapes as an array may have."""
    count = len(plan.inputs)
    for offset in range(0, count, plan.array_size):
        size = min(plan.array_size, count - offset)
        yield f"if part {offset}; then"
        for stage in plan.stages:
            yield f"    submit {stage} 1-{size}"
        if plan.last is not None:
            stage, chosen = plan.last
            tasks = _ranges(i - offset for i in chosen if offset < i <= offset + size)
            if tasks:
                yield f"    submit {stage} {tasks}"
        yield "fi"


def _ranges(numbers: Iterable[int]) -> str:
    """Ascending numbers as Slurm takes them: 1-3,7."""
    ordered = list(numbers)
    breaks = [i for i, (a, b) in enumerate(pairwise(ordered), 1) if b != a + 1]
    parts = [ordered[a:b] for a, b in pairwise([0, *breaks, len(ordered)])] if ordered else []
    return ",".join(str(p[0]) if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)


def _lines(values: Iterable[str]) -> str:
    return "".join(f"{value}\n" for value in values)
