"""report.html: one page of what was measured, from whatever stages exist."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..artifacts import atomic
from ..artifacts.manifest import Manifest, read
from ..artifacts.run_folder import RunFolder
from ..errors import ArtifactError
from ..render import image_file
from . import cells, printing
from .pictures import PICTURES

STAGES = ("classify", "init", "sphere-train", "volume", "shade", "fabricate")
CAPTIONS = {
    "surfaces": "Initial Voronoi surface, trained polygons, and the surface as written: the "
    "interface of the real Voronoi diagram.",
    "appearance": "The appearance that was learned, from new sides.",
    "cutaway": "The volumetric mesh cut open; inner cells in orange.",
    "lamp": "The object as it will be printed, lit and by day. Without --render the light casts no "
    "shadows.",
}
STYLE = """
:root{color-scheme:light dark}
body{font:16px/1.5 system-ui,sans-serif;max-width:68rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.15rem;margin:2rem 0 .5rem}
img{max-width:100%;border-radius:6px}figure{margin:1rem 0}figcaption{opacity:.75;font-size:.9rem}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.92rem}
td,th{padding:.2rem .8rem .2rem 0;text-align:left;border-bottom:1px solid #8884}
.warn{border-left:4px solid #d90;padding:.2rem .8rem;margin:.4rem 0}
.histograms{display:flex;flex-wrap:wrap;gap:0 1.5rem}
details{margin:.4rem 0}summary{cursor:pointer}.scroll{overflow-x:auto}
"""


def write(folder: RunFolder, stale: Mapping[str, str], pictures: Path | None = None) -> Path:
    """Write ``report.html`` into the run folder, and the pictures to ``pictures`` if given.

    ``stale`` says of stages that are done why they are out of date.

    Raises ArtifactError when no stage is done.
    """
    manifests = {name: found for name in STAGES if (found := folder.manifest(name))}
    for path in sorted(folder.path.glob("evaluate-*.json")):
        manifests[path.stem] = read(path)
    if not manifests:
        raise ArtifactError(f"{folder.path}: no stage is done; run: vorolight run INPUT")
    body = [_heading(manifests), _warnings(manifests, stale)]
    for name, draw in PICTURES.items():
        image = draw(folder)
        if image is None:
            continue
        data = image_file.png(image)
        if pictures is not None:
            atomic.make_folder(pictures)
            atomic.write(pictures / f"{folder.path.stem}-{name}.png", data)
        body.append(
            f'<figure><img alt="{name}" src="data:image/png;base64,'
            f'{base64.b64encode(data).decode()}"><figcaption>{CAPTIONS[name]}</figcaption></figure>'
        )
    for name, manifest in manifests.items():
        if name.startswith("evaluate-"):
            body.append(_evaluation(name, manifest))
    # A volume from before there were these figures is stale, and said to be.
    if "volume" in manifests and "quality" in manifests["volume"]["metrics"]:
        body.append(cells.section(manifests["volume"]["metrics"]))
    if "fabricate" in manifests and "printability" in manifests["fabricate"]["metrics"]:
        body.append(printing.section(folder, manifests["fabricate"]["metrics"]))
    for stage in ("init", "sphere-train"):
        if stage in manifests:
            body.append(_curves(folder, stage))
    body += [_timings(manifests), *(_details(name, found) for name, found in manifests.items())]
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(folder.path.stem)} - vorolight</title><style>{STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>\n"
    )
    target = folder.path / "report.html"
    atomic.write(target, page.encode("utf-8"))
    return target


def _table(rows: list[tuple[Any, ...]]) -> str:
    head = "".join(f"<th>{html.escape(str(cell))}</th>" for cell in rows[0])
    lines = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_shown(cell))}</td>" for cell in row) + "</tr>"
        for row in rows[1:]
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'


def _shown(value: Any) -> str:
    if value is None:
        return "not run"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _flat(value: Any, prefix: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [
            row
            for key, item in value.items()
            if key not in ("histogram", "printability")
            for row in _flat(item, f"{prefix}{key}.")
        ]
    return [(prefix.rstrip("."), value)]


def _heading(manifests: dict[str, Manifest]) -> str:
    first = next(iter(manifests.values()))
    name = manifests["classify"]["inputs"][0]["name"] if "classify" in manifests else ""
    return f"<h1>{html.escape(name)}</h1><p>Made by vorolight {first['tool_version']}.</p>"


def _warnings(manifests: dict[str, Manifest], stale: Mapping[str, str]) -> str:
    lines = [
        f'<p class="warn"><b>{stage} is out of date</b>: {html.escape(reason)}</p>'
        for stage, reason in stale.items()
    ]
    lines += [
        f'<p class="warn">{stage}: {html.escape(text)}</p>'
        for stage, manifest in manifests.items()
        for text in manifest["warnings"]
    ]
    return "".join(lines)


def _evaluation(name: str, manifest: Manifest) -> str:
    metrics = {key: value for key, value in manifest["metrics"].items() if key != "of"}
    return f"<h2>{name}</h2>" + _table([("figure", "value"), *_flat(metrics)])


def _timings(manifests: dict[str, Manifest]) -> str:
    rows: list[tuple[Any, ...]] = [("stage", "seconds", "CPU seconds", "peak MB")]
    for name, manifest in manifests.items():
        volatile = manifest["volatile"]
        rows.append(
            (name, volatile["wall_seconds"], volatile["cpu_seconds"], volatile["peak_memory_mb"])
        )
    return "<h2>Time and memory</h2>" + _table(rows)


def _details(name: str, manifest: Manifest) -> str:
    rows = [("parameter", "value"), *_flat(manifest["params"])]
    figures = "" if name.startswith("evaluate-") else _table(
        [("figure", "value"), *_flat(manifest["metrics"])]
    )  # fmt: skip
    return (
        f"<details><summary>{name}: <code>{html.escape(manifest['command'])}</code></summary>"
        f"{_table(rows)}{figures}</details>"
    )


def _curves(folder: RunFolder, stage: str) -> str:
    """The losses by iteration on a logarithmic scale, as one SVG."""
    import numpy as np

    history = folder.arrays(stage, stage)["history"]
    names = {
        "init": ("shape", "normal", "area", "centroid"),
        "sphere-train": ("intersection", "exclusion", "shape", "normal"),
    }[stage]
    if len(history) < 2:
        return ""
    logs = np.log10(np.maximum(history, 1e-8))
    low, high = np.floor(logs.min()), np.ceil(logs.max())
    colors = ("#4477aa", "#cc6677", "#228833", "#aa7733")
    lines = []
    for k, name in enumerate(names):
        x = np.linspace(60, 640, len(logs))
        y = 20 + 200 * (high - logs[:, k]) / max(high - low, 1)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        lines.append(
            f'<polyline fill="none" stroke="{colors[k]}" points="{points}"/>'
            f'<text x="650" y="{40 + 20 * k}" fill="{colors[k]}">{name}</text>'
        )
    scale = "".join(
        f'<text x="5" y="{24 + 200 * (high - e) / max(high - low, 1):.0f}" fill="currentColor">'
        f"1e{int(e)}</text>"
        for e in np.arange(low, high + 1)
    )
    return (
        f'<h2>Losses of {stage}</h2><svg viewBox="0 0 780 240" font-size="13" width="100%">'
        f"{scale}{''.join(lines)}</svg>"
    )
