"""Processes that are killed, or refused by the disk, at every place where they write."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from cases import Runs

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import kills
import write_points


@pytest.mark.parametrize("name", ["classify", "init again", "triangles"])
def test_killed_at_random_times(name: str, runs: Runs) -> None:
    dice = random.Random(f"2/{name}")
    seen, _, wrong = kills.kill(runs, name, dice)
    assert wrong == ""
    assert any(key.startswith("SIG") for key in seen)


@pytest.mark.parametrize("name", ["classify", "init again"])
def test_a_fault_at_any_write(name: str, runs: Runs) -> None:
    trials = write_points.plan(runs, [name], every=False)
    # Of every second site one fault, each time another.
    chosen = trials[:: 2 * len(write_points.FAULTS) + 1]
    assert len(chosen) > 8
    ends = [(trial, *write_points.judge(runs, trial)) for trial in chosen]
    assert [(trial, wrong) for trial, _, wrong in ends if wrong] == []
    assert "stopped" in {outcome for _, outcome, _ in ends}
