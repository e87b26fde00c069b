"""Help and completion: every command explains itself, and a shell offers its words."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from conftest import Cli

from vorolight.cli.panels import PANELS
from vorolight.stages.errors import VorolightError

BIN = Path(sys.executable).parent


def test_every_command_explains_itself_and_gives_an_example(commands: dict[str, Any]) -> None:
    for name, command in commands.items():
        about, _, example = command.help.partition("\n\nExample: ")
        assert about.split(".")[0], name
        assert "\n\n" not in about, f"{name}: more than a paragraph"
        assert f"vorolight {name}" in example, name
        for option in command.params:
            assert option.help, f"{name}: {option.name}"


def test_the_examples_are_command_lines(commands: dict[str, Any]) -> None:
    """Their options are there; a word that is none would raise."""
    import shlex

    for command in commands.values():
        example = " ".join(command.help.partition("Example: ")[2].split())
        for line in example.split("&&"):
            program, name, *words = shlex.split(line)
            assert program == "vorolight"
            served = commands[name]
            context = served.context_class(served, info_name=name)
            values, left, _ = served.make_parser(context).parse_args(words)
            assert values
            assert left == []


def test_help_ends_with_exit_codes_and_variables(program: Cli, tmp_path: Path) -> None:
    done = program("--help", cwd=tmp_path, env={"COLUMNS": "80"})
    codes, _, variables = done.stdout.partition("Exit codes:\n")[2].partition("\n\n")
    said = {int(line.split()[0]) for line in codes.splitlines()}
    assert said == {0, 1, 130, 143} | {kind.exit_code for kind in VorolightError.__subclasses__()}
    assert "\n    VOROLIGHT_RUN " in variables
    for command in ("doctor", "collect"):
        assert f"\n  {command} " in done.stdout


def test_help_lists_every_command_in_one_panel(
    cli: Cli, tmp_path: Path, commands: dict[str, Any]
) -> None:
    """In the order of their use, each with a sentence that fits on its line."""
    listed = [name for names in PANELS.values() for name in names]
    assert sorted(listed) == sorted(commands)
    done = cli("--help", cwd=tmp_path, env={"COLUMNS": "80"}).stdout
    titles = [f"\n{title}:\n" for title in PANELS]
    places = [done.index(title) for title in titles]
    assert places == sorted(places)
    panels = done[places[0] : done.index("\n  Example: ")]
    rows = [line.split() for line in panels.splitlines() if line.startswith("  ")]
    assert [row[0] for row in rows] == listed
    assert all(row[-1].endswith(".") and not row[-1].endswith("...") for row in rows)


def test_help_is_there_at_once(program: Cli, tmp_path: Path) -> None:
    took = []
    for _ in range(5):
        began = time.perf_counter()
        assert program("--help", cwd=tmp_path).returncode == 0
        took.append(time.perf_counter() - began)
        if took[-1] < 0.3:
            break
    # On a busy machine the wall clock says nothing of us; then only the imports are known.
    assert min(took) < 0.3 * max(1.0, os.getloadavg()[0])


def bash(home: Path, script: str) -> str:
    environment = {**os.environ, "HOME": str(home), "PATH": f"{BIN}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script], cwd=home, env=environment, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


WORDS = [
    ("vorolight dia", []),
    ("vorolight sph", ["sphere-train"]),
    ("vorolight init --back", ["--backend", "--background"]),
    ("vorolight init --backend ", ["scipy", "shull"]),
    ("vorolight sphere-train --faces ", ["polygon", "triangle"]),
    ("vorolight evaluate --of s", ["sphere-train"]),
    ("vorolight run --device c", ["cpu", "cuda"]),
    ("vorolight run --until fab", ["fabricate"]),
    ("vorolight run --kind ", ["field", "mesh", "points", "views"]),
    ("vorolight classify hea", ["heart"]),
    ("vorolight sample b", ["bone", "bunny"]),
    ("vorolight baseline v", ["voromesh"]),
    ("vorolight export a.vtu --format vtu", ["vtu", "vtu-tetrahedra"]),
    ("vorolight views a.obj --camera o", ["orthographic"]),
]


def test_bash_completes_what_was_installed(tmp_path: Path) -> None:
    """Installed, sourced by a new shell and asked by the function that bash would call."""
    bash(tmp_path, "vorolight --install-completion; true")
    lines = ["source ~/.bashrc", "complete -p vorolight >&2"]
    for text, _ in WORDS:
        words = text.split(" ")
        quoted = " ".join(f"'{word}'" for word in words)
        lines += [
            f"COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; COMPREPLY=()",
            '_vorolight_completion vorolight; echo "${COMPREPLY[@]}"',
        ]
    found = bash(tmp_path, "\n".join(lines)).splitlines()
    assert [sorted(line.split()) for line in found] == [offered for _, offered in WORDS]


def test_a_file_comes_before_a_field(tmp_path: Path) -> None:
    (tmp_path / "heap.obj").write_text("")
    asked = "_VOROLIGHT_COMPLETE=complete_bash COMP_CWORD=2 COMP_WORDS='vorolight init hea'"
    assert bash(tmp_path, f"{asked} vorolight").split() == []
    (tmp_path / "heap.obj").unlink()
    assert bash(tmp_path, f"{asked} vorolight").split() == ["heart"]


def test_the_script_is_shown(tmp_path: Path) -> None:
    shown = bash(tmp_path, "vorolight --show-completion bash; true")
    assert "complete -o default -F _vorolight_completion vorolight" in shown
    assert list(tmp_path.iterdir()) == []
