"""The documents: links lead somewhere, and commands, options and targets in them exist."""

from __future__ import annotations

import ast
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vorolight.cli.epilog import CODES

ROOT = Path(__file__).parent.parent
PAGES = [
    *sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]  # fmt: skip
# What was true of older versions stays as it was written.
CURRENT = [page for page in PAGES if page.name != "CHANGELOG.md"]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def code(page: Path) -> Iterator[str]:
    """Lines of code blocks, and spans of code."""
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"^```.*?\n(.*?)^```", text, re.M | re.S):
        yield from block.splitlines()
    text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    # Indented blocks follow a blank line, continued items of lists do not.
    for block in re.findall(r"\n\n((?: {4,}\S.*\n?)+)", text):
        yield from (line.strip() for line in block.splitlines())
    for span in re.findall(r"`([^`]+)`", text):
        yield " ".join(span.split())


def calls(page: Path, program: str) -> Iterator[list[str]]:
    """Words after ``program``, command by command."""
    for line in code(page):
        for part in re.split(r"&&|;|\||>", line.split("  #")[0]):
            found = re.match(rf"(?:\.venv/bin/)?{program} (.*)", part.strip())
            if found:
                yield shlex.split(found[1], comments=True)


def anchors(page: Path) -> set[str]:
    """The anchors that headings of a page have on the usual hosts."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        assert there.is_relative_to(ROOT), target
        if anchor:
            assert anchor in anchors(there), target


@pytest.mark.parametrize("page", CURRENT, ids=name_of)
def test_commands_exist_with_their_options(page: Path, commands: dict[str, Any]) -> None:
    for words in calls(page, "vorolight"):
        if words[0].startswith("-"):  # options of vorolight itself
            assert words[0] in {"-h", "--help", "--version", "--install-completion"}
            continue
        if words[0] in {"STAGE", "X"}:
            continue
        assert words[0] in commands, words
        known = {
            flag for one in commands[words[0]].params for flag in [*one.opts, *one.secondary_opts]
        }
        for word in words[1:]:
            if word.startswith("-") and len(word) > 1 and not word[1].isdigit():
                assert word.split("=")[0] in {*known, "-h", "--help"}, words


@pytest.mark.parametrize("page", CURRENT, ids=name_of)
def test_options_named_alone_exist(page: Path, commands: dict[str, Any]) -> None:
    known = {
        flag
        for command in commands.values()
        for one in command.params
        for flag in [*one.opts, *one.secondary_opts]
    } | {"--help", "--install-completion"}
    # Of other programs, each named on the page.
    others = {"--dependency", "--requeue"}
    for line in code(page):
        if line.startswith("--"):
            for word in re.findall(r"(?<![\w-])--[a-z][a-z-]*", line):
                assert word in known | others, line


@pytest.mark.parametrize("page", CURRENT, ids=name_of)
def test_targets_of_make_exist(page: Path) -> None:
    targets = {}
    for folder in ("", "examples"):
        text = (ROOT / folder / "Makefile").read_text(encoding="utf-8")
        targets[folder] = {
            name
            for names in re.findall(r"^([\w%. -]+):(?!=)", text, re.M)
            for name in names.split()
        }
    for words in calls(page, "make"):
        folder = ""
        if words[0] == "-C":
            folder, words = words[1], words[2:]
        for word in words:
            if word.startswith("-") or "=" in word:
                continue
            known = word in targets[folder] or any(
                "%" in target and re.fullmatch(target.replace("%", ".+"), word)
                for target in targets[folder]
            )
            assert known, words


def test_readme_is_short_and_leads_to_every_document() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    for page in (ROOT / "docs").glob("*.md"):
        assert f"](docs/{page.name})" in text, page.name
    words = list(calls(ROOT / "README.md", "make"))
    assert words[:2] == [["lamp"], ["test"]]


def test_every_command_is_documented(commands: dict[str, Any]) -> None:
    assert {words[0] for words in calls(ROOT / "docs" / "commands.md", "vorolight")} >= set(
        commands
    )


def test_exit_codes_are_documented() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d, ]+) \|", text.partition("## Exit codes")[2], re.M)
    assert {code for row in rows for code in row.split(", ")} == set(CODES)


def test_names_that_examples_in_python_import_exist() -> None:
    found = 0
    for page in CURRENT:
        for block in re.findall(
            r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S
        ):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom):
                    assert node.module is not None
                    for name in node.names:
                        exec(f"from {node.module} import {name.name}", {})
                        found += 1
    assert found >= 6


def test_numbers_have_a_leading_zero() -> None:
    for page in CURRENT:
        text = re.sub(r"`[^`]*`|\]\([^)]*\)", "", page.read_text(encoding="utf-8"))
        assert re.findall(r"(?<![\w.\d])\.\d+", text) == [], page


def test_diagrams_of_the_method_show_what_they_say() -> None:
    """In ``certified`` the interface is the curve; in ``intruder`` some circle has another's
    generator, which the script asserts."""
    place = ROOT / "examples" / "diagrams.py"
    spec = importlib.util.spec_from_file_location("diagrams", place)
    assert spec is not None
    assert spec.loader is not None
    drawn: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawn)
    centres, radii = drawn.spheres(waist=False)
    inner, outer = drawn.pairs(centres, radii)
    points = np.concatenate([inner, outer])
    segments, _ = drawn.interface(points, np.arange(len(points)) < len(inner))
    ends = np.array(segments).reshape(-1, 2)
    distance = np.linalg.norm(ends[:, None] - centres[None], axis=2)
    assert len(segments) == len(centres)
    assert distance.min(axis=1).max() < 1e-9
    assert "<svg" in drawn.trained(waist=True)
