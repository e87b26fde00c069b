"""The paper's tables and studies, measured with this tool: ``make tables``.

Every figure is read from the manifests of runs in the work folder. The tool makes these runs, so
that results that are up to date are not made again, and a stopped run continues. The page is
written after each part. ``make tables DATA=folder`` takes the meshes of a folder. QUICK=1 takes a
few small runs, which only show that everything works. ONLY="fields noise" makes some of the parts.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import comparisons
import shapes
import studies
from runs import NOT_RUN, Settings, quick

PARTS: dict[str, tuple[str, Callable[[Settings], str]]] = {
    "fields": ("Table 1: fields, before and after", comparisons.fields),
    "meshes": ("Table 2 and the ablation of faces: meshes, beside VoroMesh", comparisons.meshes),
    "resolutions": ("Initial resolution", studies.resolutions),
    "inner": ("Inner cells", studies.inner),
    "pipeline": ("The pipeline in four pictures", studies.pipeline),
    "noise": ("Noise against the weights of the losses", studies.noise),
    "images": ("Views", comparisons.images),
}


def page(texts: dict[str, str], given: Settings) -> str:
    """The whole page."""
    said = ", ".join(path.stem for path in given.meshes)
    parts = [
        "# The paper's tables, run again",
        "`make tables` makes this page, `make tables ONLY=name` one part of it, and `make tables "
        "DATA=folder` takes the meshes of a folder. Rows called *paper* are from *VoroLight: "
        "Learning Voronoi Surface Meshes via Sphere Intersection*. Rows called *ours* are read "
        f"from the manifests of runs, with protocol `vorolight` and n = {given.n} unless a part "
        "gives another.",
        "The paper does not name its ten meshes of Thingi10K and twelve objects of Objaverse, so "
        f"ours are others ({said}). Compare our rows with each other rather than with the "
        "paper's. VoroMesh is this tool's own implementation (`vorolight baseline voromesh`, "
        "grid 32).",
    ]
    for name, (title, _) in PARTS.items():
        parts.append(f"## {title}")
        parts.append(f"`make tables ONLY={name}`" if name in texts else NOT_RUN)
        if name in texts:
            parts.append(texts[name])
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--output", type=Path, required=True, help="the page; pictures beside it")
    parser.add_argument("--data", type=Path, help="folder of meshes")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", default=list(PARTS), choices=list(PARTS))
    asked = parser.parse_args()
    asked.work.mkdir(parents=True, exist_ok=True)
    few = ["torus", "bumpy"] if asked.quick else None
    chosen = (
        shapes.of_folder(asked.data) if asked.data else shapes.default(asked.work / "shapes", few)
    )
    given = Settings(asked.work, asked.output.parent, chosen)
    if asked.quick:
        given = quick(given)
    kept = asked.work / "texts.json"
    for name in asked.only or PARTS:
        text = PARTS[name][1](given)
        # Parts that were made from other meshes or with other settings do not belong to this page.
        stored = json.loads(kept.read_text()) if kept.is_file() else {}
        texts = stored["texts"] if stored.get("settings") == str(given) else {}
        texts[name] = text
        kept.write_text(json.dumps({"settings": str(given), "texts": texts}))
        asked.output.parent.mkdir(parents=True, exist_ok=True)
        asked.output.write_text(page(texts, given))
    print(asked.output)


if __name__ == "__main__":
    main()
