"""Kills at random times over the whole of each stage of small runs, followed by the same command.

Every run must end with the bytes of an undisturbed one. Exits with 1 if one did not.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import signal
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[1]))

from cases import CASES, Runs, differences, kept, run, run_folder
from trials import Server

# Exit codes as a shell reports them. SIGUSR1 requests a stop at the next checkpoint.
SIGNALS = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGUSR1: 85}
STEMS = {"evaluate": "evaluate-sphere-train"}
EARLIEST = 0.03
"""Number of seconds in which a process installs its handlers."""
HIT = re.compile(r"SIG\w+ -?[1-9]").match
"""Matches the ends of processes that a signal reached in time. Others end with exit code 0."""
IN_A_ROW = (1, 1, 1, 2, 3, 5)
"""Numbers of times that a run is killed before it may finish. One of them is drawn."""


BEFORE = 100_000
"""Checkpoints of polygons are numbered from here on, those of the triangles before them from 0."""


def repeated(place: Path, stem: str) -> list[int]:
    """Numbers of iterations that were computed twice, one for each time that a stage continued.

    They are accurate to a tenth of all iterations, as the log is.
    """
    path = run_folder(place) / "logs" / f"{stem}.jsonl"
    found, reached = [], {}
    for line in path.read_text().splitlines():
        entry = json.loads(line)
        if entry["event"] == "checkpoint":
            last = entry["iteration"]
            reached[last] = last
        elif entry["event"] == "progress" and reached:
            reached[last] = max(reached[last], last // BEFORE * BEFORE + entry["done"])
        elif entry["event"] == "resumed":
            last = entry["iteration"]
            found.append(reached.get(last, last) - last)
            reached = {last: last}
    return found


def kill(runs: Runs, name: str, dice: random.Random) -> tuple[Counter[str], list[int], str]:
    """One run, killed and finished: counts of what happened, lost
    iterations, and what was wrong."""
    case = CASES[name]
    commands = (*case.before, case.words)
    expected = kept(runs.after(*commands))
    place = runs.copy("trial", *case.before)
    seen: Counter[str] = Counter()
    wrong = ""
    for _ in range(dice.choice(IN_A_ROW)):
        number = dice.choice([*SIGNALS])
        when = dice.uniform(EARLIEST, runs.seconds[commands])
        done = run(runs.server, case.words, place, signals=[(when, number)])
        seen[f"{number.name} {done.code}"] += 1
        if done.code not in (0, SIGNALS[number]):
            wrong = wrong or f"{number.name} at {when:.2f} s: {done.code}: {done.stderr[-500:]}"
    done = run(runs.server, case.words, place)
    if done.code != 0:
        wrong = wrong or f"the last start ends with {done.code}: {done.stderr[-500:]}"
    wrong = wrong or differences(kept(place), expected)
    seen["finished"], seen["equal"] = 1, int(not wrong)
    return seen, repeated(place, STEMS.get(case.words[0], case.words[0])), wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="that come before the end")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    dice = random.Random(said.seed)
    seen: dict[str, Counter[str]] = {name: Counter() for name in said.only}
    again: dict[str, list[int]] = {name: [] for name in said.only}
    kills = 0
    with TemporaryDirectory() as folder, Server() as server:
        runs = Runs(server, Path(folder))
        while kills < said.kills:
            for name in said.only:
                if kills >= said.kills:
                    break
                found, twice, wrong = kill(runs, name, dice)
                seen[name] += found
                again[name] += twice
                kills += sum(found[key] for key in found if HIT(key))
                if wrong:
                    print(f"{name}: {wrong}")
                    sys.stdout.flush()
        ends = sorted({key for found in seen.values() for key in found if key.startswith("SIG")})
    print(f"\n{kills} kills; signals and how the process ended:\n")
    print(
        f"{'case':16} " + " ".join(f"{key[3:]:>9}" for key in ends) + "  finished  equal  repeated"
    )
    for name in said.only:
        counts = " ".join(f"{seen[name][key]:9}" for key in ends)
        most = f"{max(again[name])} at most" if again[name] else "-"
        done = f"{seen[name]['finished']:8}  {seen[name]['equal']:5}  {len(again[name]):7}"
        print(f"{name:16} {counts}  {done}  {most}")
    return int(any(found["finished"] != found["equal"] for found in seen.values()))


if __name__ == "__main__":
    sys.exit(main())
