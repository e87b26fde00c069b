"""What a run may use: Delaunay backends and memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from conftest import Cli


def test_backends_give_the_same_surface(tmp_path: Path, cli: Cli) -> None:
    words = ["init", "heart", "-n", 8, "--iterations", 5, "--quiet"]
    for name in ("scipy", "shull"):
        done = cli(*words, "--backend", name, "--run", name, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert json.loads((tmp_path / name / "init.json").read_text())["backend"] == name
    files = [(tmp_path / name / "init.ply").read_bytes() for name in ("scipy", "shull")]
    assert files[0] == files[1]
    done = cli("init", "--backend", "cgal", "--run", "scipy", cwd=tmp_path)
    assert done.returncode == 2
    assert "must be scipy or shull" in done.stderr
    # The result of another backend is another result.
    done = cli("init", "--iterations", 5, "--run", "shull", "--dry-run", cwd=tmp_path)
    assert "backend shull -> scipy" in done.stdout + done.stderr


def test_memory_is_estimated_and_kept_to(tmp_path: Path, program: Cli) -> None:
    words = ["init", "sphere", "-n", 10, "--iterations", 2, "--run", "run"]
    done = program(*words, "--max-memory", 0.3, cwd=tmp_path)
    assert done.returncode == 2
    assert (
        "init: needs about 0.6 GB of memory, but --max-memory allows 0.3 GB: lower -n, or raise it"
        in done.stderr
    )
    assert not (tmp_path / "run" / "init.json").exists()
    done = program(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "init: about 0.6 GB of memory" in done.stderr
    for stage, *words in (
        ("sphere-train", "--iterations", 20),
        ("volume", "--inner", 50),
        ("evaluate", "--samples", 5000),
        ("fabricate", "--sides", 6),
    ):
        assert program(stage, *words, "--run", "run", cwd=tmp_path).returncode == 0
    stems = ("classify", "init", "sphere-train", "volume", "evaluate-sphere-train", "fabricate")
    for stem in stems:
        found = json.loads((tmp_path / "run" / f"{stem}.json").read_text())["volatile"]
        # Libraries of other versions load more or less, and a field loads fewer than a mesh.
        assert 0.2 < found["peak_memory_mb"] / found["memory_estimate_mb"] < 1.2


def test_peak_memory_is_not_the_parents() -> None:
    held = np.ones(60_000_000)  # 480 MB that a child inherits in what getrusage says
    script = "from vorolight.stages.memory import peak_mb; print(peak_mb())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert float(done.stdout) < 200 < held.nbytes / 1e6
