"""HDF5 files that are made to do harm, with manifests that match, and the stages that read them.

Each must be refused in one sentence that names the file, with exit code 4 and no file changed.
Exits with 1 otherwise. A value that only the computation can find wrong, such as a coordinate of
1e300, may also be accepted, or end as a numerical failure.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[1]))

import hostile
from cases import Runs, run, run_folder
from corruptions import FINISHED, OWN, PAGES, READERS, Bench, judged, raw
from trials import Server

FINE = {"refused", "accepted", "said stale"}
"""The ends that are allowed. A report may still be drawn if it does not need the file."""


def trial(bench: Bench, stem: str, name: str, dice: random.Random) -> str:
    """How the reader of an attacked file ended. The text has a colon if that was wrong."""
    place = bench.runs.copy("trial", *FINISHED)
    path = run_folder(place) / f"{stem}.h5"
    os.mkfifo(path.with_name("pipe"))
    try:
        hostile.attack(path, name)
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        return f"not made ({error})"
    words = dice.choice(READERS[stem])
    if words[0] not in (*PAGES, "export"):
        words = (*words, "--force")
    bench.expected(words)
    limit = bench.limit(words)
    before = raw(place)
    done = run(bench.runs.server, words, place, timeout=limit)
    # The length of a history is not checked, and only reports read it.
    lenient = name.endswith(" huge") or name.startswith("history ")
    end = judged(done, limit, words, path, place, before, lambda: bench.expected(words), lenient)
    if end == "same result" and words[0] != "fabricate" and not lenient:
        # The reader did not need that array, or accepted it.
        end = "same result: taken as whole"
    if ":" in end:
        print(f"{path.name}, {name}, {' '.join(words)}: {end}", flush=True)
    return end.split(":")[0]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="attacks, chosen by --seed; default: all")
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    ends: Counter[tuple[str, str]] = Counter()
    with TemporaryDirectory() as folder, Server() as server:
        bench = Bench(Runs(server, Path(folder)))
        run_of = run_folder(bench.runs.after(*FINISHED))
        plan = [(stem, name) for stem in OWN for name in hostile.all_of(run_of / f"{stem}.h5")]
        dice = random.Random(said.seed)
        for stem, name in plan if said.count is None else dice.sample(plan, said.count):
            ends[stem, trial(bench, stem, name, dice)] += 1
    columns = sorted({end for _, end in ends})
    print(f"\n{'':22} " + " ".join(f"{end:>13}" for end in columns))
    for stem in OWN:
        print(f"{stem:22} " + " ".join(f"{ends[stem, end]:13}" for end in columns))
    return int(any(end not in FINE for _, end in ends))


if __name__ == "__main__":
    sys.exit(main())
