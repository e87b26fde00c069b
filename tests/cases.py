"""Small runs that trials start from: every stage, and what its folder held before."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from trials import Outcome, Server

ROOT = Path(__file__).parent.parent
FOLDERS = {"cli": "vorolight_cli", "stages": "stages", "schemas": "schemas"}
"""Where the packages of ``vorolight`` are."""
Command = tuple[str, ...]
"""A command line without ``--threads 1``."""


@dataclass(frozen=True)
class Case:
    """A command, and those whose results its folder holds before."""

    words: Command
    before: tuple[Command, ...] = ()


def _words(text: str) -> Command:
    return tuple(text.split())


CLASSIFY, MESH, CLOUD = map(_words, (
    "classify sphere -n 6", "classify ball.obj -n 6", "classify cloud.xyz -n 6"))  # fmt: skip
INIT = _words("init --iterations 50")
REFINED = _words("sphere-train --iterations 6 --edge-length 0.8 --refine 0.02")
TRIANGLES = _words("sphere-train --iterations 8 --faces triangle")
POLYGONS = _words("sphere-train --iterations 6 --faces polygon")
PAPER = _words("sphere-train --preset paper --iterations 120")
VOLUME = _words("volume --inner 20 --cvt-iterations 22")
EVALUATE = _words("evaluate --samples 1000")
LAMP = _words("fabricate --lamp --sides 6")
BARE = _words("fabricate --sides 4 --height 50")
BASELINE = _words("baseline voromesh --grid 6 --samples 300 --epochs 110")
TRAINED = (CLASSIFY, INIT, TRIANGLES)
POLYGONAL = (CLASSIFY, INIT, POLYGONS)

CASES = {
    "classify": Case(CLASSIFY),
    "classify mesh": Case(MESH),
    "classify points": Case(CLOUD),
    "classify again": Case((*CLASSIFY[:-1], "7"), (CLASSIFY,)),
    "init": Case(INIT, (CLASSIFY,)),
    "init mesh": Case(INIT, (MESH,)),
    "init again": Case(INIT, (CLASSIFY, _words("init --iterations 3"))),
    "triangles": Case(TRIANGLES, TRAINED[:2]),
    "triangles mesh": Case(TRIANGLES, (MESH, INIT)),
    "refined": Case(REFINED, TRAINED[:2]),
    "polygons again": Case(POLYGONS, TRAINED),
    "polygons": Case(POLYGONS, TRAINED[:2]),
    "paper": Case(PAPER, TRAINED[:2]),
    "volume": Case(VOLUME, TRAINED),
    "volume again": Case(VOLUME, (*TRAINED, _words("volume --inner 8 --cvt-iterations 2"))),
    "evaluate": Case(EVALUATE, TRAINED),
    "lamp": Case(LAMP, POLYGONAL),
    "lamp again": Case(LAMP, (*POLYGONAL, BARE)),
    "bare again": Case(BARE, (*POLYGONAL, LAMP)),
    "baseline": Case(BASELINE, (CLASSIFY,)),
}


@dataclass
class Runs:
    """Folders after commands, each made once."""

    server: Server
    folder: Path
    seconds: dict[tuple[Command, ...], float] = field(default_factory=dict)
    _made: dict[tuple[Command, ...], Path] = field(default_factory=dict)

    def after(self, *commands: Command) -> Path:
        """A folder in which ``commands`` were run; not to be changed."""
        if commands in self._made:
            return self._made[commands]
        place = self.folder / f"{len(self._made):03d}" / "work"
        self._made[commands] = place
        if not commands:
            place.mkdir(parents=True)
            write_inputs(place)
            return place
        shutil.copytree(self.after(*commands[:-1]), place, symlinks=True)
        done = run(self.server, commands[-1], place)
        assert done.code == 0, f"{' '.join(commands[-1])}: {done.stderr}"
        self.seconds[commands] = done.seconds
        return place

    def copy(self, name: str, *commands: Command) -> Path:
        """A folder after ``commands`` that may be changed; it replaces the former of the name."""
        place = self.folder / name / "work"
        shutil.rmtree(place.parent, ignore_errors=True)
        shutil.copytree(self.after(*commands), place, symlinks=True)
        return place


def run(server: Server, words: Command, place: Path, **more: Any) -> Outcome:
    """A trial of a command with one thread."""
    threads = () if words[0] in ("report", "status", "export", "compare") else ("--threads", "1")
    return server.trial([*words, *threads], place, **more)


def run_folder(place: Path) -> Path:
    return next(place.glob("*.vorolight"))


def kept(place: Path) -> dict[str, Any]:
    """What must not differ between two runs: folders, files by digest, manifests less their
    volatile block. Logs and the report tell of times."""
    found: dict[str, Any] = {}
    for path in sorted(place.rglob("*")):
        name = path.relative_to(place).as_posix()
        if "/logs" in name or name.endswith("report.html"):
            continue
        if path.is_symlink():
            found[name] = f"link to {path.readlink()}"
        elif not path.is_file():
            found[name] = "folder" if path.is_dir() else "no file"
        elif re.fullmatch(r"[^/]+\.vorolight/[a-z-]+\.json", name):
            found[name] = {
                k: v for k, v in json.loads(path.read_bytes()).items() if k != "volatile"
            }
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def snapshot(folder: Path) -> dict[str, bytes]:
    """All files by their names, but the logs."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != "logs"
    }


def without_volatile(files: dict[str, bytes]) -> dict[str, Any]:
    """All files but the report, manifests less their volatile block."""
    result: dict[str, Any] = dict(files)
    for name in files:
        if name.endswith(".json"):
            result[name] = {k: v for k, v in json.loads(files[name]).items() if k != "volatile"}
    result.pop("report.html", None)
    return result


def differences(now: dict[str, Any], expected: dict[str, Any]) -> str:
    """The names of what differs, in words; empty if nothing does."""
    words = []
    for name in sorted(now.keys() | expected.keys()):
        if now.get(name) != expected.get(name):
            kind = (
                "left over" if name not in expected else "missing" if name not in now else "other"
            )
            words.append(f"{kind}: {name}")
    return "; ".join(words)


def write_inputs(place: Path) -> None:
    """A mesh and a point cloud of a ball."""
    from conftest import fibonacci, sphere_mesh

    vertices, triangles = sphere_mesh(2.0, 2)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    (place / "ball.obj").write_text("\n".join(lines) + "\n")
    points = fibonacci(600, 2.0)
    np.savetxt(place / "cloud.xyz", np.concatenate([points, points / 2.0], axis=1))
