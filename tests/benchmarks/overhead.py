"""The cost of safety: the share of a run's time for checkpoints, manifests, checksums, logs and
locks.

Run with ``make bench-overhead INPUT=bunny.obj N=25``. Every function that writes, reads or hashes
files of the run folder is timed in a run of all stages. The data files of a stage, which would be
written in any case, are listed separately.
"""

from __future__ import annotations

import argparse
import functools
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from results import write

SPENT: dict[str, float] = defaultdict(float)
_inside = False


def timed(owner: Any, name: str, what: str) -> None:
    """Add the time of ``owner.name`` to ``SPENT[what]``, unless another
    timed function called it."""
    plain: Callable[..., Any] = getattr(owner, name)

    @functools.wraps(plain)
    def call(*args: Any, **kwargs: Any) -> Any:
        global _inside
        if _inside:
            return plain(*args, **kwargs)
        _inside, begun = True, time.perf_counter()
        try:
            return plain(*args, **kwargs)
        finally:
            SPENT[what] += time.perf_counter() - begun
            _inside = False

    setattr(owner, name, call)


def instrument() -> None:
    from vorolight.stages.artifacts import atomic, checkpoints, fingerprint, lock, log, manifest
    from vorolight.stages.artifacts.run_folder import RunFolder
    from vorolight.stages.engine import freshness

    for name in ("save", "latest", "clear"):
        timed(checkpoints.Checkpoints, name, "checkpoints")
    timed(log.StageLog, "_write", "log")
    for name in ("encode", "read"):
        timed(manifest, name, "manifests")
    timed(RunFolder, "manifest", "manifests")
    for name in ("of_file", "of_bytes", "of_json"):
        timed(fingerprint, name, "checksums")
    timed(atomic, "write", "data, synced")
    for name in ("move", "sweep", "make_folder"):
        timed(atomic, name, "manifests")
    timed(lock, "_put", "lock")
    timed(freshness, "state", "manifests")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("-n", type=int, default=25)
    asked = parser.parse_args()
    sys.path.insert(0, os.fspath(Path(__file__).parent))
    from vorolight.stages.artifacts.run_folder import RunFolder
    from vorolight.stages.engine import registry, runner
    from vorolight.stages.engine.session import Session
    from vorolight.stages.inputs.resolve import identify

    instrument()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        session = Session(RunFolder(Path(folder) / "run"), input=identify(os.fspath(asked.input)))
        for name in ("classify", "init", "sphere-train", "volume", "evaluate", "fabricate"):
            stage = registry.get(name)
            options = {"classify": {"n_init": asked.n}, "fabricate": {"lamp": True}}
            SPENT.clear()
            begun = time.perf_counter()
            runner.execute(session, name, stage.params(**options.get(name, {})))
            took = time.perf_counter() - begun
            rows.append({"stage": name, "seconds": took, **SPENT})
    kinds = [
        k for k in dict.fromkeys(k for row in rows for k in row) if k not in ("stage", "seconds")
    ]
    rows.append(
        {"stage": "all"} | {k: sum(row.get(k, 0) for row in rows) for k in ["seconds", *kinds]}
    )
    print(
        "stage         seconds  " + "  ".join(f"{kind:>13s}" for kind in kinds) + "   without data"
    )
    for row in rows:
        spent = [row.get(kind, 0.0) for kind in kinds]
        rest = sum(spent) - row.get("data, synced", 0.0)
        row["share"] = rest / row["seconds"]
        cells = "  ".join(f"{1000 * value:10.1f} ms" for value in spent)
        print(f"{row['stage']:12s}  {row['seconds']:7.2f}  {cells}  {row['share']:12.2%}")
    write("overhead", rows)


if __name__ == "__main__":
    main()
