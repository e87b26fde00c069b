"""The same run in other surroundings gives the same bytes."""

from __future__ import annotations

from pathlib import Path

from cases import differences, kept, write_inputs
from conftest import QUICK, Cli

SURROUNDINGS = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "LANG": "C", "LC_ALL": "C", "COLUMNS": "40"},
    {"PYTHONHASHSEED": "77", "TZ": "Pacific/Kiritimati", "LANG": "de_DE.UTF-8",
     "LC_ALL": "C.UTF-8", "COLUMNS": "200"},
)  # fmt: skip


def test_the_same_bytes_elsewhere(tmp_path: Path, program: Cli) -> None:
    lamp = ["--lamp", "--cell-size", "16mm"]  # few tubes
    words = ["run", "ball.obj", "-n", 6, *lamp, *QUICK]
    found = []
    for number, (name, umask, threads, more) in enumerate(
        zip(("a", "Ünwieldy näme, with spaces"), (0o022, 0o077), (1, 2), SURROUNDINGS, strict=True)
    ):
        place = tmp_path / f"{number}" / name
        place.mkdir(parents=True)
        write_inputs(place)
        home = place.parent / "home"
        home.mkdir()
        done = program(
            *words, "--threads", threads, cwd=place, umask=umask, env={**more, "HOME": str(home)}
        )
        assert done.returncode == 0, done.stderr
        found.append(kept(place))
    assert differences(*found) == ""
    assert len(found[0]) > 20
