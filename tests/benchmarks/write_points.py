"""A fault at every operation that changes the run folder: kills, a full disk, a read-only disk.

After a kill the same command must end with the bytes of an undisturbed run and leave nothing else.
An error must be reported in one sentence. The older result of the stage must then still be there,
unless the error occurs while files are exchanged. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from cases import CASES, Case, Runs, differences, kept, run
from trials import Server

KILLS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
FAULTS: dict[str, dict[str, Any]] = {
    **{name: {"signal": int(number)} for name, number in KILLS.items()},
    "SIGKILL in a write": {"signal": int(signal.SIGKILL), "half": True},
    "ENOSPC": {"error": "ENOSPC"},
    "ENOSPC from then on": {"error": "ENOSPC", "lasting": True},
    "EROFS from then on": {"error": "EROFS", "lasting": True},
    "EACCES": {"error": "EACCES"},
    "EIO": {"error": "EIO"},
    "EIO from then on": {"error": "EIO", "lasting": True},
}
EXCHANGE = ("rename", "remove", "link")
"""Operations that exchange finished files. An error in them may lose the older result."""


@dataclass(frozen=True)
class Trial:
    case: str
    site: str
    at: int
    fault: str


def plan(runs: Runs, names: list[str], every: bool) -> list[Trial]:
    """Each fault at each place: at the first of several similar operations, or at ``every`` one.

    The writes of several checkpoints are similar operations.
    """
    trials = []
    for name in names:
        case = CASES[name]
        place = runs.copy("plan", *case.before)
        done = run(runs.server, case.words, place, fault={})
        assert done.code == 0, done.stderr
        for site, count in Counter(done.operations).items():
            trials += [
                Trial(name, site, at, fault)
                for at in range(count if every else 1)
                for fault in FAULTS
                if site.startswith("write ") or "half" not in FAULTS[fault]
            ]
    return trials


def judge(runs: Runs, trial: Trial) -> tuple[str, str]:
    """How a trial ended, in a word, and what was wrong; empty if nothing was."""
    case, fault = CASES[trial.case], FAULTS[trial.fault]
    place = runs.copy("trial", *case.before)
    before = kept(place)
    expected = kept(runs.after(*case.before, case.words))
    first = run(runs.server, case.words, place, fault={"site": trial.site, "at": trial.at, **fault})
    between = kept(place)
    wrong = _wrong_end(first, fault)
    outcome = {0: "ignored"}.get(first.code, "stopped")
    if not wrong and first.code == 0:
        # Files that could not be removed stay until the next start.
        wrong = "" if _stands(expected, between) else differences(between, expected)
    elif not wrong and "error" in fault and not _stands(before, between):
        outcome = "older result lost"
        if not trial.site.startswith(EXCHANGE) and not fault.get("lasting"):
            wrong = "the older result is lost: " + differences(between, before)
    wrong = wrong or _claims_too_much(runs, case, place, before, between, expected)
    again = run(runs.server, case.words, place)
    if again.code != 0:
        wrong = wrong or f"the next start ends with {again.code}: {again.said or again.stderr}"
    wrong = wrong or differences(kept(place), expected)
    return outcome, wrong


def _wrong_end(first: Any, fault: dict[str, Any]) -> str:
    if first.hung:
        return "hung"
    if "error" in fault:
        fine = first.code == 0 or (first.code == 2 and first.clean)
    elif fault["signal"] == signal.SIGKILL:
        fine = first.code == -signal.SIGKILL
    else:
        fine = first.code in (0, 128 + fault["signal"])
    return "" if fine else f"ended with {first.code}: {first.said or first.stderr}"


def _stands(before: dict[str, Any], between: dict[str, Any]) -> bool:
    """Whether everything that was there is still there, unchanged."""
    return all(between.get(name) == value for name, value in before.items())


def _claims_too_much(
    runs: Runs, case: Case, place: Path, before: Any, between: Any, expected: Any
) -> str:
    """The fault of a result that is neither the older nor the new one, and is still called done."""
    if _stands(before, between) or _stands(expected, between):
        return ""
    import json

    seen = run(runs.server, ("status", "--verify", "--json"), place)
    states = [json.loads(line) for line in seen.stdout.splitlines()]
    of = [entry for entry in states if entry["stage"].startswith(case.words[0])]
    if seen.code not in (0, 4) or any(entry["state"] == "done" for entry in of):
        return f"status of what is neither old nor new: {seen.stderr or of}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="trials, chosen by --seed; default: all")
    parser.add_argument("--every", action="store_true", help="also operations that are alike")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    ends: Counter[tuple[str, str, str]] = Counter()
    with TemporaryDirectory() as folder, Server() as server:
        runs = Runs(server, Path(folder))
        trials = plan(runs, said.only, said.every)
        sites = len(trials)
        if said.count is not None and said.count < sites:
            trials = random.Random(said.seed).sample(trials, said.count)
        for trial in sorted(trials, key=lambda one: list(CASES).index(one.case)):
            outcome, wrong = judge(runs, trial)
            ends[trial.case, trial.fault, "wrong" if wrong else outcome] += 1
            if wrong:
                print(f"{trial.case}: {trial.fault} at {trial.site} {trial.at}: {wrong}")
                sys.stdout.flush()
    print(f"\n{len(trials)} of {sites} trials\n")
    columns = ["stopped", "ignored", "older result lost", "wrong"]
    print(f"{'case':16} {'fault':20} " + " ".join(f"{name:>17}" for name in columns))
    for case, fault in dict.fromkeys((case, fault) for case, fault, _ in ends):
        counts = " ".join(f"{ends[case, fault, name]:17}" for name in columns)
        print(f"{case:16} {fault:20} {counts}")
    return int(any(end == "wrong" for _, _, end in ends))


if __name__ == "__main__":
    sys.exit(main())
