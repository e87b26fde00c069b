"""``vorolight collect``: tables read back by csv and pyarrow."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Cli, sphere_mesh, write_ply

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import collection


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """A folder of three runs: one whole as far as it goes, one begun, one damaged."""
    folder = tmp_path_factory.mktemp("runs")
    write_ply(folder / "sphere.ply", *sphere_mesh(1.0, 2))
    for words in (
        ["init", "sphere.ply", "-n", 6, "--iterations", 2, "--seed", 3, "--threads", 1],
        ["evaluate", "--of", "init", "--samples", 1000, "--run", "sphere.vorolight"],
        ["classify", "torus", "-n", 7],
    ):
        done = cli(*words, cwd=folder)
        assert done.returncode == 0, done.stderr
    damaged = Path(shutil.copytree(folder / "sphere.vorolight", folder / "worse.vorolight"))
    (damaged / "init.json").write_text('{"schema": "of something else"}')
    return folder


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def scalars(name: str, value: Any) -> dict[str, Any]:
    """The figures that a table must have of a manifest's metrics."""
    if isinstance(value, dict):
        return {
            k: v for key, part in value.items() for k, v in scalars(f"{name}.{key}", part).items()
        }
    return {} if isinstance(value, list) else {name: value}


def test_every_figure_of_every_manifest_is_in_the_table(runs: Path, cli: Cli) -> None:
    done = cli("collect", ".", "-o", "all.csv", cwd=runs)
    assert done.returncode == 0, done.stderr
    rows = {row["run"]: row for row in read_csv(runs / "all.csv")}
    assert list(rows) == ["sphere.vorolight", "torus.vorolight", "worse.vorolight"]
    whole = rows["sphere.vorolight"]
    for stem in ("classify", "init", "evaluate-init"):
        record = json.loads((runs / "sphere.vorolight" / f"{stem}.json").read_text())
        spent = record["volatile"]
        wanted = {
            **scalars(stem, record["metrics"]),
            **scalars(f"{stem}.params", record["params"]),
            f"{stem}.state": "complete",
            f"{stem}.warnings": len(record["warnings"]),
            **{f"{stem}.{key}": spent[key] for key in ("wall_seconds", "cpu_seconds")},
            f"{stem}.peak_memory_mb": spent["peak_memory_mb"],
        }
        assert len(wanted) > 10
        for name, value in wanted.items():
            found = whole[name]
            if isinstance(value, float):
                assert float(found) == value, name
            else:
                assert found == ("" if value is None else str(value)), name
    classify = json.loads((runs / "sphere.vorolight" / "classify.json").read_text())
    about = {"input": "sphere.ply", "kind": "mesh", "n_init": "6", "seed": "3", "threads": "1"}
    about["input_sha256"] = classify["inputs"][0]["sha256"]
    assert {name: whole[name] for name in about} == about
    assert whole["volume.state"] == rows["torus.vorolight"]["init.state"] == "missing"
    assert rows["torus.vorolight"]["init.generators"] == ""
    # The other two are as if the damaged one were not there.
    assert whole["error"] == rows["torus.vorolight"]["error"] == ""


def test_what_cannot_be_read_is_a_row_and_a_warning(runs: Path, cli: Cli) -> None:
    done = cli("collect", "worse.vorolight", "torus.vorolight", cwd=runs)
    assert done.returncode == 0
    worse, torus = csv.DictReader(done.stdout.splitlines())
    assert "init.json" in worse["error"]
    assert worse["init.state"] == "damaged"
    assert worse["evaluate-init.state"] == torus["classify.state"] == "complete"
    assert torus["error"] == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("warning: worse.vorolight: worse.vorolight/init.json")


def test_a_folder_that_is_closed_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(path: Path) -> Iterator[Path]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", closed)
    assert collection.row(RunFolder(tmp_path)) == {
        "run": str(tmp_path),
        "error": "cannot be read (Permission denied)",
    }


def test_parquet_holds_the_same_as_csv(runs: Path, cli: Cli) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    for name in ("all.csv", "all.parquet"):
        assert cli("collect", ".", "-o", name, "-q", cwd=runs).returncode == 0
    found = parquet.read_table(runs / "all.parquet")
    texts = read_csv(runs / "all.csv")
    assert found.column_names == list(texts[0])
    for row, text in zip(found.to_pylist(), texts, strict=True):
        assert {k: "" if v is None else str(v) for k, v in row.items()} == text
    kinds = {name: str(found.schema.field(name).type) for name in found.column_names}
    assert kinds["init.generators"] == kinds["n_init"] == "int64"
    assert kinds["evaluate-init.chamfer.cd2"] == kinds["init.wall_seconds"] == "double"
    assert kinds["evaluate-init.gates.closed"] == "bool"
    assert kinds["run"] == "string"


def test_columns_of_mixed_values_become_text_and_large_numbers_stay_exact() -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    import io

    table: collection.Table = {
        "mixed": [True, "not run", None],
        "numbers": [1, 2.5, None],
        "seed": [2**63, 1, None],
        "nothing": [None, None, None],
        "run": ["caf\udce9", "b", None],
    }
    found = parquet.read_table(io.BytesIO(collection.as_parquet(table)))
    assert found["mixed"].to_pylist() == ["True", "not run", None]
    assert found["numbers"].to_pylist() == [1.0, 2.5, None]
    assert found["seed"].to_pylist() == [str(2**63), "1", None]
    assert found["nothing"].null_count == 3
    assert found["run"].to_pylist() == ["caf?", "b", None]


def test_columns_are_selected_by_patterns(runs: Path, cli: Cli) -> None:
    words = ["collect", ".", "--columns", "*.wall_seconds", "--columns", "evaluate-*.chamfer.cd2"]
    done = cli(*words, cwd=runs)
    names = done.stdout.splitlines()[0].split(",")
    assert names[:2] == ["run", "error"]
    assert names[2:] == [
        "classify.wall_seconds",
        "init.wall_seconds",
        "evaluate-init.wall_seconds",
        "evaluate-init.chamfer.cd2",
    ]


BAD = [
    (["nowhere"], 4, "nowhere: no such folder"),
    (["bare"], 4, "bare: is not a run folder and contains none"),
    (["sphere.vorolight", "--columns", "unicorns.*"], 2, "--columns unicorns.*: no column"),
    (["sphere.vorolight", "-o", "table.xlsx"], 2, "table.xlsx: must end with .csv or .parquet"),
    (["sphere.vorolight", "-o", "no/table.csv"], 2, "no/table.csv: cannot be written there"),
]


@pytest.mark.parametrize(("words", "code", "reason"), BAD, ids=lambda value: str(value)[:40])
def test_bad_words(words: list[str], code: int, reason: str, runs: Path, cli: Cli) -> None:
    (runs / "bare").mkdir(exist_ok=True)
    done = cli("collect", *words, cwd=runs)
    assert (done.returncode, done.stdout) == (code, "")
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1


def test_without_pyarrow_the_extra_is_named(runs: Path, tmp_path: Path, program: Cli) -> None:
    (tmp_path / "pyarrow.py").write_text("raise ImportError('as if it were not there')\n")
    words = ["collect", ".", "-o", str(tmp_path / "all.parquet")]
    done = program(*words, cwd=runs, env={"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 69
    assert "pip install 'vorolight[cluster]'" in done.stderr
    assert not (tmp_path / "all.parquet").exists()


def test_a_run_named_twice_is_one_row(runs: Path) -> None:
    twice = [runs, runs / "torus.vorolight", runs / "bare" / ".." / "torus.vorolight"]
    (runs / "bare").mkdir(exist_ok=True)
    assert len(collection.run_folders(twice)) == 3
