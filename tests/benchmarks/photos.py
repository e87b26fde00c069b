"""The table of photographs, for which there is no reference: how well masks and pictures are met.

Run with ``make table-photos VIEWS="folder ..."``. ``vorolight views`` makes such a folder from a
textured mesh. PSNR is over the foreground of views that were held out.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from surfaces import cli


def row(views: Path, n: int, keep: Path | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        run = (keep / views.name) if keep else Path(folder) / "run"
        start = time.perf_counter()
        cli("run", views, "-n", n, "--until", "sphere-train", "--run", run)
        trained = time.perf_counter()
        cli("shade", "--render", "orbit", "--run", run)
        shaded = time.perf_counter()
        cli("evaluate", "--run", run)
        read = {
            stem: json.loads((run / f"{stem}.json").read_text())["metrics"]
            for stem in ("classify", "shade", "evaluate-sphere-train")
        }
    found = read["evaluate-sphere-train"]
    return {
        "views": read["classify"]["input"]["views"],
        "overlap": found["mask_overlap"],
        "components": found["topology"]["components"],
        "euler_number": found["topology"]["euler_number"],
        "certificate": found["certificate"]["holds"],
        "held_out": len(read["shade"]["held_out_views"]),
        "psnr": read["shade"]["held_out_psnr"],
        "seconds": trained - start,
        "shade_seconds": shaded - trained,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("views", nargs="+", type=Path)
    parser.add_argument("-n", type=int, default=40)
    parser.add_argument("--keep", type=Path, help="a folder for the runs")
    given = parser.parse_args()
    print("| views | mask overlap mean, worst | Euler number, components | certificate "
          "| PSNR, held out | s to the surface, to shade |\n|---|---|---|---|---|---|")  # fmt: skip
    for views in given.views:
        found = row(views, given.n, given.keep)
        psnr = "" if found["psnr"] is None else f"{found['psnr']:.1f} dB, {found['held_out']}"
        cells = [
            f"{views.name} ({found['views']})",
            f"{found['overlap']['mean']:.3f}, {found['overlap']['worst']:.3f}",
            f"{found['euler_number']}, {found['components']}",
            "holds" if found["certificate"] else "fails",
            psnr,
            f"{found['seconds']:.0f}, {found['shade_seconds']:.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
