"""Damaged and hostile files of a run: one sentence, no traceback, no hang, no file changed."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from cases import Runs, run_folder

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import attacks
import corruptions
import hostile


@pytest.fixture(scope="module")
def bench(runs: Runs) -> corruptions.Bench:
    return corruptions.Bench(runs)


def test_damaged_files(bench: corruptions.Bench, capsys: pytest.CaptureFixture[str]) -> None:
    # `make corruptions` tries many more.
    ends = [corruptions.trial(bench, random.Random(f"test/{number}")) for number in range(12)]
    assert [end for end in ends if end[2] not in corruptions.FINE] == [], capsys.readouterr().out
    assert sum(end == "refused" for _, _, end in ends) > 2


def test_hostile_arrays(bench: corruptions.Bench, capsys: pytest.CaptureFixture[str]) -> None:
    run_of = run_folder(bench.runs.after(*corruptions.FINISHED))
    dice = random.Random(1)
    for stem in corruptions.OWN:
        plan = hostile.all_of(run_of / f"{stem}.h5")
        for name in dice.sample(sorted(plan), 2):
            end = attacks.trial(bench, stem, name, dice)
            assert end in attacks.FINE, capsys.readouterr().out
