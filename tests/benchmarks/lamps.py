"""The table of lamps: their parts, the time they took, and the results of the slicer.

Run with ``make table-lamps RUNS="heart.vorolight bunny.vorolight"`` on runs made with
``vorolight run SHAPE --lamp --slice``; ``make -C examples`` makes some.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

HEAD = (
    "shape", "tubes", "genus of the tubes", "thinnest tube, plate, mm", "light", "stands to",
    "warned of", "layers (height / layer)", "filament, printing time", "s, peak GB",
)  # fmt: skip


def row(run: Path) -> tuple[str, ...]:
    """The cells of one lamp's line."""
    manifest: dict[str, Any] = json.loads((run / "fabricate.json").read_text())
    metrics, volatile, params = manifest["metrics"], manifest["volatile"], manifest["params"]
    checks = {check["name"]: check for check in metrics["printability"]}
    lattice, written = metrics["lattice"], metrics["as_written"]
    genus = (
        f"{lattice['genus']} = {lattice['edges_less_nodes_plus_parts']} - "
        f"{metrics['plates']} plates - {len(metrics['sealed_faces'])} sealed"
    )
    if lattice["unexplained"]:
        genus += f" + {lattice['unexplained']}"
    thin = ", ".join(f"{checks[name]['value']:.2f}" for name in ("tubes", "plates"))
    light = metrics.get("light")
    place = "none"
    if light is not None:
        place = f"{light['light_diameter_mm']:g} mm in the {metrics['base']}"
    warned = [name for name, check in checks.items() if check["verdict"] != "ok"]
    sliced = written.get("slicer")
    layers = filament = "not run"
    if sliced is not None:
        layers = f"{sliced['layers']} ({sliced['expected_layers']})"
        filament = f"{sliced['filament_g']:.0f} g, {sliced['printing_time']}"
    seconds = f"{volatile['wall_seconds']:.0f}, {(volatile['peak_memory_mb'] or 0) / 1000:.1f}"
    extras = [name for name in ("slice", "render") if params[name]]
    if extras:
        seconds += f" (with --{' and --'.join(extras)})"
    return (
        run.stem, str(metrics["tubes"]), genus, thin, place,
        f"{checks['stability']['value']:.0f} degrees" if "stability" in checks else "",
        ", ".join(f"{name} ({checks[name]['value']:g})" for name in warned) or "nothing",
        layers, filament, seconds,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    for run in parser.parse_args().runs:
        print("| " + " | ".join(row(run)) + " |", flush=True)


if __name__ == "__main__":
    main()
