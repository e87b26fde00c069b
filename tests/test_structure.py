"""The rules of the layout: layers, package list, schemas, size of modules."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from cases import FOLDERS, ROOT

from vorolight.schemas import build
from vorolight.stages.engine import registry
from vorolight.stages.engine.params import options

ORDER = (
    ("errors", "memory", "compiled", "torch_start", "child", "progress"),
    ("artifacts",),
    ("mesh",),
    ("solvers",),
    ("formats",),
    ("render",),
    ("remesh",),
    ("voronoi",),
    ("inputs",),
    ("engine.params", "engine.stage"),
    ("metrics",),
    ("training",),
    ("fabrication",),
    ("baselines",),
    ("report",),
    ("sphere_train_params", "fabricate_params"),
    tuple(name.replace("-", "_") for name in registry.ALL),
    ("engine",),
    ("run",),
)
"""Modules and packages of ``stages``: each row may import itself and the rows above it. The command
line may import all of them."""


def modules() -> list[Path]:
    return [path for folder in FOLDERS.values() for path in sorted((ROOT / folder).rglob("*.py"))]


def imported(path: Path, types: bool) -> set[str]:
    """Absolute names of the project's modules that a module imports, with ``types`` also those that
    it needs for annotations only."""
    name = next(
        f"vorolight.{short}"
        for short, folder in FOLDERS.items()
        if path.is_relative_to(ROOT / folder)
    )
    top = ROOT / FOLDERS[name.split(".")[1]]
    package = [*name.split("."), *path.relative_to(top).parent.parts]
    tree = ast.parse(path.read_text())
    ignored = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and not types
        for inner in ast.walk(node)
    }
    found = set()
    for node in ast.walk(tree):
        if id(node) in ignored:
            continue
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{stem}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {target for target in found if target.startswith("vorolight.")}


def row(name: str) -> int:
    """The row of ORDER of a module of ``stages``."""
    names = {each: place for place, names in enumerate(ORDER) for each in names}
    within = name.removeprefix("vorolight.stages.").split(".")
    return next(names[part] for part in (".".join(within[:2]), within[0]) if part in names)


def graph(types: bool) -> dict[str, set[str]]:
    """The modules of the project that each module imports."""
    names = {}
    for short, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names[".".join(["vorolight", short, *parts]).removesuffix(".__init__")] = path
    found = {}
    for name, path in names.items():
        targets = {
            target if target in names else target.rpartition(".")[0]
            for target in imported(path, types)
        }
        found[name] = targets & names.keys() - {name}
    return found


def test_nothing_imports_what_is_above_it() -> None:
    faults = []
    for name, targets in graph(types=True).items():
        if not name.startswith("vorolight.stages."):
            continue
        for target in targets:
            if target.startswith("vorolight.cli") or (
                target.startswith("vorolight.stages.") and row(target) > row(name)
            ):
                faults.append((name, target))
    assert faults == []


def test_stages_meet_on_disk_only() -> None:
    stages = {f"vorolight.stages.{name.replace('-', '_')}" for name in registry.ALL}
    assert not any(
        targets & stages for name, targets in graph(types=True).items() if name in stages
    )


def test_no_module_imports_itself_by_way_of_others() -> None:
    left = graph(types=False)
    while ends := [name for name, targets in left.items() if not targets & left.keys()]:
        for name in ends:
            del left[name]
    assert sorted(left) == []


def test_every_package_is_listed_and_typed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    listed = set(project["tool"]["setuptools"]["packages"])
    there = set()
    for short, folder in FOLDERS.items():
        assert (ROOT / folder / "py.typed").is_file()
        for path in (ROOT / folder).rglob("__init__.py"):
            inner = path.parent.relative_to(ROOT / folder).parts
            there.add(".".join(["vorolight", short, *inner]))
    assert listed == there
    assert not (ROOT / "vorolight" / "__init__.py").exists()


def test_module_names_and_sizes() -> None:
    for path in [*modules(), *(ROOT / "tests").rglob("*.py")]:
        assert path.stem not in {"utils", "common", "helpers"}
        assert len(path.read_text().splitlines()) <= 400, path


def test_no_test_imports_a_test() -> None:
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [each.name for each in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.startswith("test_") for name in names), path


def test_every_dependency_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = sum(project["optional-dependencies"].values(), project["dependencies"])
    pinned = {
        line.split("==")[0].lower()
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    assert {entry.split(">=")[0].lower() for entry in wanted} <= pinned
    assert all(">=" in entry for entry in wanted)


@pytest.mark.parametrize("name", registry.ALL)
def test_schema_files_are_those_of_the_params(name: str) -> None:
    stored = (ROOT / "schemas" / f"{name}.json").read_text()
    assert stored == build.encode(build.stage_schema(name)), "run: make schemas"
    assert json.loads(stored)["$id"].endswith(name)


@pytest.mark.parametrize("name", registry.ALL)
def test_every_option_is_explained(name: str) -> None:
    for option in options(registry.get(name).params):
        assert option.meaning.endswith("."), option.name


def test_help_does_not_import_the_heavy_libraries() -> None:
    program = (
        "import sys; sys.argv = ['vorolight', '--help']\n"
        "from vorolight.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'scipy', 'trimesh', 'pymeshlab', 'numpy', 'h5py', 'manifold3d'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stderr.strip() == "[]"
    for command in ("init", "sphere-train", "fabricate", "sample", "status"):
        assert command in done.stdout
