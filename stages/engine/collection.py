"""Many runs as one table: a row for each run folder, from its manifests."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ..artifacts import manifest
from ..artifacts.run_folder import SUFFIX, RunFolder
from ..errors import ArtifactError, BackendMissing, UsageError
from . import registry

Value = str | int | float | bool | None
Table = dict[str, list[Value]]
"""Values of all rows by column; None where a run has no value."""

FIRST = (
    "run", "error", "input", "input_sha256", "kind", "tool_version", "n_init", "seed", "threads",
    "device", "backend",
)  # fmt: skip
"""Columns about a run as a whole; those of a stage are called ``stage.figure``."""
KEPT = ("run", "error")
"""Columns that stay whatever columns are selected."""


def run_folders(paths: Sequence[Path]) -> list[RunFolder]:
    """Those ``paths`` that are run folders, and the run folders inside the other ones, each once.

    Raises ArtifactError for a path that is neither.
    """
    found: dict[Path, RunFolder] = {}
    for path in paths:
        if not path.is_dir():
            raise ArtifactError(
                f"{path}: no such folder; give run folders, or folders that contain run folders"
            )
        if path.resolve().suffix == SUFFIX or (path / "classify.json").is_file():
            inner = [path]
        else:
            inner = sorted(entry for entry in path.glob(f"*{SUFFIX}") if entry.is_dir())
        if not inner:
            raise ArtifactError(
                f"{path}: is not a run folder and contains none (*{SUFFIX}); check the path"
            )
        for run in inner:
            found.setdefault(run.resolve(), RunFolder(run))
    return list(found.values())


def row(folder: RunFolder) -> dict[str, Value]:
    """Values of the manifests of a run, by column.

    What cannot be read is reported in the column ``error``. A stage with a manifest counts as
    complete; whether it is stale is not checked.
    """
    found: dict[str, Value] = {"run": str(folder.path), "error": None}
    try:
        names = {entry.name for entry in folder.path.iterdir()}
    except OSError as error:
        return {**found, "error": f"cannot be read ({error.strerror})"}
    errors = []
    for stem in _stems(names):
        found[f"{stem}.state"] = "missing"
        if f"{stem}.json" not in names:
            continue
        try:
            stored = manifest.read(folder.file(stem, "json"))
        except ArtifactError as error:
            found[f"{stem}.state"] = "damaged"
            errors.append(str(error))
            continue
        if stem == "classify":
            found |= _whole(folder.path, stored)
        found |= _figures(stem, stored)
    return {**found, "error": "; ".join(errors) or None}


def _stems(names: set[str]) -> list[str]:
    """The stages of a whole run, then all others that were run."""
    stages = [name for name in registry.ORDER if name != "evaluate"]
    others = [name for name in registry.ALL if name not in registry.ORDER]
    stages += [name for name in others if f"{name}.json" in names]
    return stages + sorted(
        name.removesuffix(".json")
        for name in names
        if name.startswith("evaluate-") and name.endswith(".json")
    )


def _whole(run: Path, classify: manifest.Manifest) -> dict[str, Value]:
    entry = classify["inputs"][0]
    place = entry["path"] and os.path.normpath(run / entry["path"])
    return {
        "input": place or entry["name"],
        "input_sha256": entry["sha256"],
        "kind": entry["kind"],
        "tool_version": classify["tool_version"],
        "n_init": classify["params"].get("n_init"),
        "seed": classify["seed"],
        "threads": classify["volatile"].get("threads"),
        "device": classify["device"],
        "backend": classify["backend"],
    }


def _figures(stem: str, stored: manifest.Manifest) -> dict[str, Value]:
    spent = stored["volatile"]
    taken = {name: spent.get(name) for name in ("wall_seconds", "cpu_seconds", "peak_memory_mb")}
    about = {"state": stored["status"], **taken, "warnings": len(stored["warnings"])}
    measured = {**about, "params": stored["params"], **stored["metrics"]}
    return dict(_flat(stem, measured))


def _flat(name: str, value: Any) -> Iterator[tuple[str, Value]]:
    """The scalars in ``value`` by their path; lists are left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}", inner)
    elif not isinstance(value, list):
        yield name, value


def gather(folders: Sequence[RunFolder], told: Callable[[int, dict[str, Value]], None]) -> Table:
    """The rows of ``folders`` as columns, ordered by stage.

    ``told`` is called after each row with the number of rows so far and the row.
    """
    table: Table = {}
    for number, folder in enumerate(folders):
        found = row(folder)
        for name in found.keys() - table.keys():
            table[name] = [None] * number
        for name, values in table.items():
            values.append(found.get(name))
        told(number + 1, found)
    stems = list(dict.fromkeys(name.partition(".")[0] for name in table))
    order = [*FIRST, *registry.ALL, *sorted(stems)]
    return {name: table[name] for name in sorted(table, key=lambda name: _place(name, order))}


def _place(name: str, order: list[str]) -> tuple[int, int, str]:
    """Sort key of a column: its stage, then times and options before figures."""
    stem, _, figure = name.partition(".")
    leading = ("state", "wall_seconds", "cpu_seconds", "peak_memory_mb", "warnings")
    rank = leading.index(figure) if figure in leading else len(leading)
    return order.index(stem), rank, figure


def selected(table: Table, patterns: Sequence[str]) -> Table:
    """The columns that match one of ``patterns``, and KEPT; all of them without patterns.

    Raises UsageError for a pattern that no column matches.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in table):
            stems = ", ".join(dict.fromkeys(name.partition(".")[0] for name in table))
            raise UsageError(
                f"--columns {pattern}: no column matches; the columns of these runs begin "
                f"with {stems}"
            )
    return {
        name: values
        for name, values in table.items()
        if not patterns or name in KEPT or any(fnmatchcase(name, pattern) for pattern in patterns)
    }


def as_csv(table: Table) -> bytes:
    """Numbers in the shortest form that reads back exactly; nothing where there is none."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return out.getvalue().encode("utf-8", "surrogateescape")


def require_parquet() -> None:
    """Raise BackendMissing unless Parquet files can be written."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise BackendMissing(
            "a .parquet file needs pyarrow, which is not installed; run: pip install "
            "'vorolight[cluster]', or write a .csv file"
        ) from None


def as_parquet(table: Table) -> bytes:
    """Each column with one type; text if its values have several types."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    columns = {}
    for name, values in table.items():
        kinds = {type(value) for value in values if value is not None}
        large = any(type(value) is int and abs(value) >= 2**63 for value in values)
        if kinds == {bool}:
            form = arrow.bool_()
        elif kinds == {int} and not large:
            form = arrow.int64()
        elif float in kinds and kinds <= {int, float}:
            form = arrow.float64()
            values = [None if value is None else float(value) for value in values]
        else:
            form = arrow.string()
            values = [None if value is None else _text(value) for value in values]
        columns[name] = arrow.array(values, form)
    out = io.BytesIO()
    parquet.write_table(arrow.table(columns), out)
    return out.getvalue()


def _text(value: Value) -> str:
    """Replace what is not text in a file name by question marks, since Parquet accepts only
    text."""
    return str(value).encode("utf-8", "replace").decode("utf-8")
