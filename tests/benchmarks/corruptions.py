"""Damaged files of a run, and the commands that read them.

A damaged file must be refused in one sentence that names it, with exit code 4 (3 for an input, 75
for a lock) and no file changed. If the damage does no harm, the result must be that of intact
files. Exits with 1 after a traceback, a hang, a silent wrong result, or anything else.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import damages
from cases import (
    BARE,
    CLASSIFY,
    EVALUATE,
    INIT,
    LAMP,
    POLYGONS,
    VOLUME,
    Command,
    Runs,
    differences,
    kept,
    run,
    run_folder,
)
from trials import Outcome, Server

SECONDS, MEMORY_MB = 10.0, 2000.0
"""The seconds that a command may take beyond those with intact files, and its
largest memory in MB."""
FINISHED = (CLASSIFY, INIT, POLYGONS, VOLUME, EVALUATE, LAMP, ("report",))
OTHER = (
    (*CLASSIFY[:-1], "7"), INIT, (*POLYGONS, "--weight-smooth", "9"),
    (*VOLUME[:2], "9", *VOLUME[3:]), EVALUATE, BARE,
)  # fmt: skip
OWN = dict(zip(("classify", "init", "sphere-train", "volume", "evaluate-sphere-train",
                "fabricate"), FINISHED, strict=False))  # fmt: skip
PAGES = ("report", "compare")
"""Commands that draw for seconds. They are tried less often than their place in the lists says."""
EXPORT = ("export", "cells.vtu")
READERS: dict[str, list[Command]] = {
    "classify": [INIT],
    "init": [POLYGONS],
    "sphere-train": [VOLUME, EVALUATE, LAMP],
    "volume": [EXPORT, ("evaluate", "--of", "volume", "--samples", "1000")],
    "evaluate-sphere-train": [("report",)],
    "fabricate": [("report",)],
}
"""The commands that read the files of each stage."""
FINE = {"refused", "same result", "said stale", "up to date", "accepted", "nothing to damage"}
"""The ends that are allowed."""
CHECKPOINTS, LOCK = "checkpoint", "lock"


@dataclass
class Bench:
    """Intact runs, and the results of commands on them."""

    runs: Runs
    results: dict[Command, dict[str, Any]] = field(default_factory=dict)
    interrupted: Path | None = None

    def commands(self, stem: str) -> list[Command]:
        other = run_folder(self.runs.after(*OTHER))
        compare = ("compare", "sphere.vorolight", str(other), "-o", "page.html")
        readers = READERS[stem]
        stages = [words for words in readers if words[0] not in ("report", "export")]
        own = OWN[stem]
        return [
            *readers, *((*words, "--force") for words in stages), own, (*own, "--verify"),
            *((*words, "--verify") for words in stages), ("status", "--json"),
            ("status", "--verify", "--json"), ("report",), compare,
        ]  # fmt: skip

    def expected(self, words: Command) -> dict[str, Any]:
        if words not in self.results:
            place = self.runs.copy("whole", *FINISHED)
            done = run(self.runs.server, words, place)
            assert done.code == 0, f"{words}: {done.stderr}"
            self.results[words] = result(place)
            self.runs.seconds[*FINISHED, words] = done.seconds
        return self.results[words]

    def limit(self, words: Command) -> float:
        """The number of seconds that a command may take, which includes running its stage again."""
        known = self.runs.seconds.items()
        return SECONDS + 3 * max(took for past, took in known if past[-1][0] == words[0])

    def begun(self) -> Path:
        """A folder whose training was killed after it had written checkpoints."""
        if self.interrupted is None:
            self.interrupted = self.runs.copy("interrupted", CLASSIFY, INIT)
            site = "write sphere.vorolight/checkpoints/sphere-train/#/.#.h5.tmp.#"
            fault = {"site": site, "at": 3, "signal": 9}
            done = run(self.runs.server, POLYGONS, self.interrupted, fault=fault)
            assert done.code == -9, done.stderr
        return self.interrupted


def result(place: Path) -> dict[str, Any]:
    """All files that a command may leave, with reports."""
    pages = {
        path.relative_to(place).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in place.rglob("*.html")
    }
    return kept(place) | pages


def raw(place: Path) -> dict[str, str]:
    """The digest of every file, and the type of everything that is not a file.

    Logs, checkpoints and the lock are left out, because a stage that does not finish may leave
    them.
    """
    found = {}
    for path in sorted(place.parent.rglob("*")):
        name = path.relative_to(place.parent).as_posix()
        if "/logs" in name or "/checkpoints" in name or name.endswith("/.lock"):
            continue
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"  # noqa: PTH115
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = "folder" if path.is_dir() else "device"
    return found


def crashed(done: Outcome, limit: float) -> str:
    """The fault of a command that no input excuses; empty if there is none."""
    if done.hung:
        return f"hang: more than {limit:.0f} s"
    if done.code < 0 or done.code in (1, 99) or "Traceback" in done.stderr:
        return f"crash: exit {done.code}: {done.stderr[-400:].strip()}"
    if done.rss_mb > MEMORY_MB:
        return f"memory: {done.rss_mb:.0f} MB"
    return ""


def judged(
    done: Outcome, limit: float, words: Command, path: Path, place: Path,
    before: dict[str, str], expected: Callable[[], dict[str, Any]], lenient: bool,
) -> str:  # fmt: skip
    """How a command with a damaged file ended. The text has a colon if that was wrong."""
    wrong = crashed(done, limit)
    if wrong:
        return wrong
    after = raw(place)
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    if done.code != 0:
        # A folder or device in place of a file counts as missing, but it may prevent writing.
        obstacle = done.code == 2 and not path.is_file()
        if done.code not in (3, 4, 75) and not obstacle and not (lenient and done.code in (2, 6)):
            return f"exit {done.code}: {done.stderr[-400:].strip()}"
        if not done.clean:
            return f"not one sentence: {done.stderr}"
        stem = path.name.split(".")[0]
        # A report reads many manifests. For one with forged figures it names only the folder.
        forged = "a figure is missing, or has another form than this version writes" in done.stderr
        named = path.name in done.stderr or (stem and stem in done.stderr) or forged
        if not obstacle and not named:
            return f"file not named: {done.stderr}"
        if changed:
            return f"files changed: {', '.join(changed)}; {done.stderr[-200:]}"
        return "refused"
    if any(name.startswith(("outside", "pipe")) for name in changed):
        return f"changed outside: {', '.join(changed)}"
    if words[0] == "status":
        states = [json.loads(line) for line in done.stdout.splitlines()]
        stale = any(entry["state"] != "done" for entry in states)
        return "said stale" if stale else "unnoticed" if "--verify" in words else "up to date"
    now = result(place)
    if now == expected():
        return "same result"
    name = path.relative_to(place).as_posix()
    if not changed and "up to date" in done.stdout + done.stderr:
        return "up to date"
    if words[0] in PAGES:
        page = next(iter(place.rglob("report.html" if words[0] == "report" else "page.html")))
        if "changed" in page.read_text() or "missing" in page.read_text():
            return "said stale"
    rest = differences(
        {k: v for k, v in now.items() if k != name},
        {k: v for k, v in expected().items() if k != name},
    )
    if not rest:
        return "same result"
    return "accepted" if lenient else f"silent: {rest}"


def trial(bench: Bench, dice: random.Random) -> tuple[str, str, str]:
    """One random damage: the kind of the file, the damage, and how the command ended."""
    kind = dice.choices((CHECKPOINTS, LOCK, ""), (1, 1, 12))[0]
    if kind == CHECKPOINTS:
        place = bench.runs.folder / "trial" / "work"
        shutil.rmtree(place.parent, ignore_errors=True)
        shutil.copytree(bench.begun(), place)
        paths = sorted(run_folder(place).glob("checkpoints/*/*/*.h5"))
        words, whole = POLYGONS, lambda: result(bench.runs.after(CLASSIFY, INIT, POLYGONS))
    else:
        place = bench.runs.copy("trial", *FINISHED)
        if kind == LOCK:
            paths = [run_folder(place) / ".lock"]
            paths[0].write_text(json.dumps({"host": os.uname().nodename, "pid": 4194300}))
            words = (*INIT, "--force")
        else:
            listed = [run_folder(place) / f"{stem}.*" for stem in OWN]
            paths = sorted(p for pattern in listed for p in place.glob(f"*/{pattern.name}"))
            words = ()
        whole = lambda: bench.expected(words)  # noqa: E731
    path = dice.choice(paths)
    if not words:
        commands = bench.commands(path.name.split(".")[0])
        words = dice.choices(commands, [1 - 0.8 * (one[0] in PAGES) for one in commands])[0]
    whole()
    limit = bench.limit(words)
    name = dice.choice(damages.of_file(path))
    restore = dice.random() < 0.5
    other, outside = run_folder(bench.runs.after(*OTHER)), place.parent / "outside"
    if name in damages.BYTES and not path.read_bytes():
        return kind or path.suffix, name, "nothing to damage"
    content = path.read_bytes()
    damages.damage(name, path, dice, restore, other, outside)
    before = raw(place)
    done = run(bench.runs.server, words, place, timeout=limit)
    lenient = name.endswith("sealed")
    end = judged(done, limit, words, path, place, before, whole, lenient)
    if end == "unnoticed":
        same = path.is_file() and not path.is_symlink() and _means_the_same(path, content)
        end = "same result" if same or lenient else "silent: status calls it done"
    if ":" in end:
        tail = " (time restored)" if restore else ""
        print(f"{path.relative_to(place)}, {name}{tail}, {' '.join(words)}: {end}", flush=True)
    return kind or path.suffix, name, end.split(":")[0]


def _means_the_same(path: Path, content: bytes) -> bool:
    """Whether a file has the same meaning as before: a manifest's volatile block
    and blanks may differ."""
    now = path.read_bytes()
    if now == content or path.suffix != ".json":
        return now == content
    records = [json.loads(data) for data in (now, content)]
    return bool(records[0] | {"volatile": 0} == records[1] | {"volatile": 0})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    ends: Counter[tuple[str, str, str]] = Counter()
    with TemporaryDirectory() as folder, Server() as server:
        bench = Bench(Runs(server, Path(folder)))
        for number in range(said.count):
            kind, name, end = trial(bench, random.Random(f"{said.seed}/{number}"))
            ends[kind, name, end] += 1
            if (number + 1) % 100 == 0:
                print(f"{number + 1} of {said.count}", file=sys.stderr, flush=True)
    columns = sorted({end for _, _, end in ends})
    for rows in (
        sorted({kind for kind, _, _ in ends}),
        sorted({name for _, name, _ in ends}),
    ):
        print(f"\n{'':28} " + " ".join(f"{end:>13}" for end in columns))
        for row in rows:
            counts = [
                sum(n for key, n in ends.items() if row in key[:2] and key[2] == end)
                for end in columns
            ]
            print(f"{row:28} " + " ".join(f"{count:13}" for count in counts))
    return int(any(end not in FINE for _, _, end in ends))


if __name__ == "__main__":
    sys.exit(main())
