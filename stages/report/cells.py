"""The report's section on the cells of the volume: distributions and histograms."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from .curves import histogram
from .tables import number, table

NAMES = {
    "volume": "cell volume",
    "face_area": "face area",
    "edge_length": "edge length",
    "non_orthogonality": "non-orthogonality, degrees",
    "skewness": "skewness",
    "aspect": "aspect ratio",
    "size_ratio": "size of neighbours, larger over smaller",
}
COLUMNS = ("least", "mean", "median", "p95", "p99", "most")


def section(metrics: Mapping[str, Any]) -> str:
    """HTML of the figures of stage volume."""
    quality = metrics["quality"]
    facts = [
        (
            "boundary faces that differ from the written surface",
            f"{metrics['changed_faces']} of {metrics['boundary_faces']}",
        ),
        ("cells that fail a check", str(sum(metrics["faults"].values()))),
        (
            "volume of the cells divided by the enclosed volume, minus 1",
            f"{metrics['volume_error']:.1e}",
        ),
        ("CVT steps", f"{metrics['cvt_iterations']}"),
        (
            "distance from generator to centroid divided by the cell size: mean, largest",
            f"{metrics['centroid_distance_mean']:.4f}, {metrics['centroid_distance_max']:.4f}",
        ),
        (
            "size of cells at the surface divided by that of inner cells",
            f"{metrics['surface_to_inner_size']:.3f}",
        ),
        (
            "faces whose cells differ in size by less than 2",
            f"{100 * metrics['neighbours_within_factor_2']:.1f} %",
        ),
    ]
    rows = [(html.escape(name), html.escape(value)) for name, value in facts]
    lines = [
        (title, *(number(quality[name][column]) for column in COLUMNS))
        for name, title in NAMES.items()
    ]
    pictures = "".join(
        histogram(title, quality[name]["histogram"]["edges"], quality[name]["histogram"]["counts"])
        for name, title in NAMES.items()
    )
    return (
        f"<h2>Cells</h2>{table(('', ''), rows, 'numbers')}"
        f"{table(('', *COLUMNS), lines, 'numbers')}"
        '<p class="help">Non-orthogonality, skewness and aspect ratio are OpenFOAM\'s.</p>'
        f'<div class="figures">{pictures}</div>'
    )
