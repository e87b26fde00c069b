"""The top of the report: the most important figures, and the stages that are not done."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from ..artifacts.manifest import Manifest
from .tables import number

MEASURED = ("sphere-train", "volume", "init")
"""The evaluation at the top is that of the first of these that exists."""
COMMANDS = {"classify": "classify INPUT -n 25", "fabricate": "fabricate --lamp"}


def cards(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the headline figures, each with a value to compare with."""
    items = [_faces(manifests), _certificate(manifests), *_measured(manifests)]
    items.append(_printable(manifests))
    return '<div class="cards">' + "".join(_card(*item) for item in items) + "</div>"


Item = tuple[str, str, str, str]
"""Title, figure, text below it, and a class: good, bad, doubt or none."""


def _card(title: str, figure: str, under: str, kind: str) -> str:
    return (
        f'<div class="card {kind}"><p class="title">{html.escape(title)}</p>'
        f'<p class="figure">{html.escape(figure)}</p>'
        f'<p class="under">{html.escape(under)}</p></div>'
    )


def _not_run(title: str, command: str) -> Item:
    return title, "not run", f"vorolight {command}", "none"


def _faces(manifests: Mapping[str, Manifest]) -> Item:
    for stage, which in (("sphere-train", "of the written surface"), ("init", "at the start")):
        if stage in manifests:
            facts = manifests[stage]["metrics"]["topology"]
            parts = facts["components"]
            under = f"Euler number {facts['euler_number']}, {parts} component"
            under += "" if parts == 1 else "s"
            return f"Faces {which}", number(int(facts["faces"])), under, ""
    if "classify" in manifests:
        metrics = manifests["classify"]["metrics"]
        edge = f"edge {number(float(metrics['spacing']))}"
        return "Interior voxels", number(int(metrics["interior_voxels"])), edge, ""
    return _not_run("Faces", COMMANDS["classify"])


def _certificate(manifests: Mapping[str, Manifest]) -> Item:
    if "sphere-train" not in manifests:
        return _not_run("Certificate", "sphere-train")
    metrics = manifests["sphere-train"]["metrics"]
    found = metrics.get("certificate") or {}
    share = (metrics.get("conformity") or {}).get("pair_area_share")
    under = "" if share is None else f"{100 * share:.2f} % of the area between pairs"
    if found.get("holds"):
        return "Certificate", "holds", under or "the surface is the diagram's interface", "good"
    return "Certificate", "fails", under, "doubt"


def _measured(manifests: Mapping[str, Manifest]) -> list[Item]:
    stage = next((name for name in MEASURED if f"evaluate-{name}" in manifests), None)
    titles = ("CD² × 1000", "F1", "Normal consistency")
    if stage is None:
        return [_not_run(title, "evaluate") for title in titles]
    metrics = manifests[f"evaluate-{stage}"]["metrics"]
    chamfer, protocol = metrics["chamfer"], metrics["protocol"]
    of = "" if stage == MEASURED[0] else f", of {stage}"
    floor = f"sampling floor {number(1e3 * chamfer['sampling_floor'], 3)}{of}"
    return [
        (titles[0], number(1e3 * chamfer["cd2"], 3), floor, ""),
        (titles[1], f"{chamfer['f1']:.4f}", f"within {protocol['threshold']:g} of the diagonal{of}",
         ""),
        (titles[2], f"{metrics['fidelity']['normal_consistency']:.4f}", f"1 is the most{of}", ""),
    ]  # fmt: skip


def _printable(manifests: Mapping[str, Manifest]) -> Item:
    if "fabricate" not in manifests:
        return _not_run("Printable", COMMANDS["fabricate"])
    metrics = manifests["fabricate"]["metrics"]
    doubts = [check["name"] for check in metrics.get("printability", [])
              if check["verdict"] in ("warn", "fail")]  # fmt: skip
    under = f"to note: {', '.join(doubts)}" if doubts else "every check is fine"
    if metrics.get("printable"):
        return "Printable", "yes", under, "good"
    return "Printable", "no", under, "bad"


def not_done(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the stages that are missing, with the commands that run them."""
    wanted = ["classify", "init", "sphere-train", "volume"]
    kind = manifests["classify"]["inputs"][0]["kind"] if "classify" in manifests else ""
    wanted += ["shade"] if kind == "views" else []
    missing = [name for name in (*wanted, "fabricate") if name not in manifests]
    lines = [(name, COMMANDS.get(name, name)) for name in missing]
    if not any(name.startswith("evaluate-") for name in manifests):
        lines.insert(-1 if "fabricate" in missing else len(lines), ("evaluate", "evaluate"))
    if not lines:
        return ""
    items = "".join(
        f"<li>{stage}: <code>vorolight {html.escape(command)}</code></li>"
        for stage, command in lines
    )
    return f'<div class="absent"><p>Not run, so not on this page:</p><ul>{items}</ul></div>'


def outdated(stale: Mapping[str, str]) -> str:
    """HTML of the stages that are stale, and why."""
    return "".join(
        f'<p class="warn"><b>{html.escape(stage)} is out of date</b>: {html.escape(reason)}</p>'
        for stage, reason in stale.items()
    )


def warnings(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the warnings of the stages."""
    lines = "".join(
        f'<p class="warn">{html.escape(stage)}: {html.escape(text)}</p>'
        for stage, manifest in manifests.items()
        for text in manifest["warnings"]
    )
    return f"<h2>Warnings</h2>{lines}" if lines else ""


def heading(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the input of the run."""
    any_one: dict[str, Any] = next(iter(manifests.values()))
    version = html.escape(any_one["tool_version"])
    if "classify" not in manifests:
        return f"<header><h1>A run</h1><p>vorolight {version}</p></header>"
    entry = manifests["classify"]["inputs"][0]
    kind = {"mesh": "a mesh", "points": "a point cloud", "field": "a field", "views": "views"}
    about = f"{kind[entry['kind']]}, {manifests['classify']['params']['n_init']} voxels along its "
    about += f"longest side; vorolight {version}"
    return f"<header><h1>{html.escape(entry['name'])}</h1><p>{about}</p></header>"
