"""The source archive and the wheel that is built from it alone."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from cases import FOLDERS, ROOT


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of both: without more words, build makes the wheel of the unpacked archive."""
    folder = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_wheel_holds_everything(built: Path) -> None:
    names = set(zipfile.ZipFile(next(built.glob("*.whl"))).namelist())
    for short, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in {".py", ".json", ".ini", ".js", ".css"} or path.name == "py.typed":
                assert f"vorolight/{short}/{path.relative_to(ROOT / folder).as_posix()}" in names
    tops = {name.split("/")[0] for name in names}
    assert tops == {"vorolight", next(iter(tops - {"vorolight"}))}
    assert not any(name.startswith("vorolight/tests") for name in names)


def test_the_source_archive_holds_the_repository_and_no_more(built: Path) -> None:
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        files = [entry.name.partition("/")[2] for entry in archive if entry.isfile()]
    made = {"PKG-INFO", "setup.cfg"}
    held = {name for name in files if not name.startswith("vorolight.egg-info/")} - made
    try:
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not in a repository")
    there = {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    assert held == there - {".gitignore", ".ci/run", ".github/workflows/ci.yml"}


def test_the_metadata_is_complete(built: Path) -> None:
    wheel = zipfile.ZipFile(next(built.glob("*.whl")))
    name = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    about = message_from_bytes(wheel.read(name))
    classifiers = about.get_all("Classifier") or []
    for minor in (11, 12, 13):
        assert f"Programming Language :: Python :: 3.{minor}" in classifiers
    assert about["License-Expression"] == "MIT"
    assert about["Description-Content-Type"] == "text/markdown"
    assert str(about.get_payload()).startswith("# vorolight")
    extras = set(about.get_all("Provides-Extra") or [])
    assert {"fast", "render", "images", "cluster"} <= extras
