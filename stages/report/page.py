"""report.html: one page with the figures and pictures of all finished stages."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..artifacts import atomic
from ..artifacts.manifest import Manifest, foreign, read
from ..artifacts.run_folder import RunFolder
from ..errors import ArtifactError
from ..render import image_file
from . import cells, curves, headline, printing, quality, viewer
from .pictures import PICTURES, up_of
from .surfaces import collect
from .tables import facts, number, table

STAGES = ("classify", "init", "sphere-train", "volume", "shade", "baseline", "fabricate")
CAPTIONS = {
    "surfaces": "Initial Voronoi surface, trained polygons, and the surface as written: the "
    "interface of the real Voronoi diagram.",
    "appearance": "The appearance that was learned, from new directions.",
    "cutaway": "The volumetric mesh cut open; inner cells in orange.",
    "lamp": "The object as it will be printed, lit and by day. Without --render the light casts no "
    "shadows.",
}


def manifests_of(folder: RunFolder) -> dict[str, Manifest]:
    """The manifests of a run's finished stages, evaluations last.

    Raises ArtifactError when no stage is done.
    """
    found = {name: stored for name in STAGES if (stored := folder.manifest(name))}
    for path in sorted(folder.path.glob("evaluate-*.json")):
        found[path.stem] = read(path)
    if not found:
        raise ArtifactError(f"{folder.path}: no stage is done; run: vorolight run INPUT")
    return found


def write(folder: RunFolder, stale: Mapping[str, str], pictures: Path | None = None) -> Path:
    """Write ``report.html`` into the run folder, and the pictures to ``pictures`` if given.

    ``stale`` gives the reasons of stages that are out of date. Raises ArtifactError if no stage is
    done, or if a file is missing or damaged.
    """
    with foreign(str(folder.path)):
        return _write(folder, stale, pictures)


def _write(folder: RunFolder, stale: Mapping[str, str], pictures: Path | None) -> Path:
    manifests = manifests_of(folder)
    measured = {key: found for key, found in manifests.items() if key.startswith("evaluate-")}
    collected = collect(folder)
    panel = viewer.Panel(folder.path.resolve().stem, collected.shapes, {})
    body = [
        headline.heading(manifests),
        headline.cards(manifests),
        headline.not_done(manifests),
        headline.outdated(stale),
        viewer.section([panel], [up_of(folder)], True, "The surfaces"),
        "".join(f'<p class="help">{html.escape(text)}</p>' for text in collected.left_out),
        headline.warnings(manifests),
        *_pictures(folder, pictures),
        quality.evaluations(measured),
        quality.conformity(manifests),
        quality.gates(measured),
        curves.distributions(collected.shapes),
        curves.losses(folder),
    ]
    # A volume from before these figures existed is stale, and reported as such.
    if "volume" in manifests and "quality" in manifests["volume"]["metrics"]:
        body.append(cells.section(manifests["volume"]["metrics"]))
    if "fabricate" in manifests and "printability" in manifests["fabricate"]["metrics"]:
        body.append(printing.section(folder, manifests["fabricate"]["metrics"]))
    body += [timings(manifests), "<h2>Parameters and figures of the stages</h2>"]
    body += [_details(name, found) for name, found in manifests.items()]
    target = folder.path / "report.html"
    title = f"{folder.path.resolve().stem} - vorolight"
    atomic.write(target, document(title, body).encode("utf-8"))
    return target


def document(title: str, body: Sequence[str]) -> str:
    """The whole page. It loads nothing, and runs no script but that of the viewer."""
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src {viewer.script_hash()}"
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{html.escape(title)}</title><style>{viewer.asset('style.css')}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def _pictures(folder: RunFolder, target: Path | None) -> list[str]:
    figures = []
    for name, draw in PICTURES.items():
        image = draw(folder)
        if image is None:
            continue
        data = image_file.png(image)
        if target is not None:
            atomic.make_folder(target)
            atomic.write(target / f"{folder.path.stem}-{name}.png", data)
        figures.append(picture(name, data, CAPTIONS[name]))
    return ["<h2>Pictures</h2>", *figures] if figures else []


def picture(name: str, data: bytes, caption: str) -> str:
    """HTML of a PNG with its caption."""
    return (
        f'<figure><img alt="{html.escape(name)}" src="data:image/png;base64,'
        f'{base64.b64encode(data).decode()}"><figcaption>{html.escape(caption)}</figcaption>'
        "</figure>"
    )


def timings(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the time and memory of the stages."""
    rows = []
    for name, manifest in manifests.items():
        volatile = manifest["volatile"]
        memory = volatile["peak_memory_mb"]
        shown = "–" if memory is None else number(round(memory))
        seconds = (f"{volatile[key]:.1f}" for key in ("wall_seconds", "cpu_seconds"))
        rows.append((html.escape(name), *seconds, shown))
    total = (
        f"{sum(found['volatile'][key] for found in manifests.values()):.1f}"
        for key in ("wall_seconds", "cpu_seconds")
    )
    rows.append(("together", *total, ""))
    head = ("stage", "seconds", "CPU seconds", "peak memory, MB")
    return f"<h2>Time and memory</h2>{table(head, rows, 'numbers')}"


def told_to(manifest: Manifest) -> dict[str, Any]:
    """Everything a stage was given that decides its result."""
    params: dict[str, Any] = manifest["params"]
    return params | {key: manifest[key] for key in ("seed", "device", "backend")}


def _details(name: str, manifest: Manifest) -> str:
    figures = ""
    if not name.startswith("evaluate-"):
        figures = "<h3>Figures</h3>" + facts(manifest["metrics"], ("histogram", "printability"))
    return (
        f"<details><summary>{html.escape(name)} <code>{html.escape(manifest['command'])}</code>"
        f"</summary><h3>Parameters</h3>{facts(told_to(manifest), (), 'default')}"
        f"{figures}</details>"
    )
