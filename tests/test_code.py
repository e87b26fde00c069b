"""Fields that are Python functions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Cli

from vorolight.stages.errors import InputError, UsageError
from vorolight.stages.inputs.field.code import file_of, is_code
from vorolight.stages.inputs.resolve import identify, identify_field

BALL = "def ball(x, y, z, xp):\n    return xp.sqrt(x * x + y * y + z * z) - {}\n"


def test_names_of_functions() -> None:
    assert is_code("a.b_2:f")
    for other in ("x**2 + y**2 - 1", "a:b:c", "a.b", ":f", "a:", "1a:f", "a-b:f", "a:f()"):
        assert not is_code(other)


def test_code_runs_only_if_allowed(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "mine.py").write_text("open('ran', 'w')\n" + BALL.format(1.0))
    done = cli("classify", "--field", "mine:ball", "-n", 8, cwd=tmp_path)
    assert done.returncode == 2
    assert "--allow-code" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]
    done = cli("init", "--field", "mine:ball", "--allow-code", "-n", 8, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ran").exists()
    folder = tmp_path / "formula.vorolight"
    stored = json.loads((folder / "classify.json").read_text())
    assert stored["command"] == "vorolight classify --field mine:ball --n-init 8 --allow-code"
    # What is recorded is no leave to run it.
    done = cli("sphere-train", cwd=tmp_path)
    assert done.returncode == 2
    assert "--allow-code" in done.stderr
    done = cli("sphere-train", "--allow-code", "--iterations", 5, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # Other code is another input.
    (tmp_path / "mine.py").write_text(BALL.format(0.9))
    done = cli("status", "--json", cwd=tmp_path)
    states = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert states[0]["state"] == "stale", states[0]


def test_bad_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, code, said in (
        ("m1", "raise RuntimeError('no')", "fails"),
        ("m2", "f = 3", "no function f"),
        ("m3", "def f(x, y, z, xp):\n    return 1.0", "does not return a number for each point"),
        ("m4", "import numpy as np\ndef f(x, y, z, xp):\n    return np.sqrt(x.numpy())", "numpy"),
        ("m5", "def f(x, y, z, xp):\n    return x + 1000", "inside"),
    ):
        Path(f"{name}.py").write_text(code)
        identity = identify_field(f"{name}:f")
        with pytest.raises(UsageError, match="--allow-code"):
            identity.open().bounding_box()
        with pytest.raises(InputError, match=said):
            replace(identity, allow_code=True).open().bounding_box()
    with pytest.raises(InputError, match="no module"):
        identify_field("not_there_at_all:f")


def test_finding_a_module_does_not_import_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("raise RuntimeError")
    (tmp_path / "pack" / "field.py").write_text("raise RuntimeError")
    assert file_of("pack.field:f") == tmp_path / "pack" / "field.py"


def test_code_is_no_input_by_itself() -> None:
    with pytest.raises(InputError, match="no such file"):
        identify("os:system")
