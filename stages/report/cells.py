"""The report's section on the cells of the volume: distributions and histograms."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

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
WIDTH, HEIGHT, FOOT = 240, 90, 18


def section(metrics: Mapping[str, Any]) -> str:
    """HTML of what stage volume measured."""
    quality = metrics["quality"]
    facts = [
        (
            "boundary faces that are not the surface's as written",
            f"{metrics['changed_faces']} of {metrics['boundary_faces']}",
        ),
        ("cells that fail a check", str(sum(metrics["faults"].values()))),
        ("volume of the cells over the enclosed one, less 1", f"{metrics['volume_error']:.1e}"),
        ("CVT steps", f"{metrics['cvt_iterations']}"),
        (
            "distance from generator to centroid, over the cells' size: mean, most",
            f"{metrics['centroid_distance_mean']:.4f}, {metrics['centroid_distance_max']:.4f}",
        ),
        ("size of cells at the surface over inner ones", f"{metrics['surface_to_inner_size']:.3f}"),
        (
            "faces whose cells differ in size by less than 2",
            f"{100 * metrics['neighbours_within_factor_2']:.1f} %",
        ),
    ]
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
        for name, value in facts
    )
    head = "".join(f"<th>{name}</th>" for name in ("", *COLUMNS))
    lines = "".join(
        f"<tr><td>{title}</td>"
        + "".join(f"<td>{quality[name][column]:.4g}</td>" for column in COLUMNS)
        + "</tr>"
        for name, title in NAMES.items()
    )
    pictures = "".join(_histogram(title, quality[name]) for name, title in NAMES.items())
    return (
        f'<h2>Cells</h2><div class="scroll"><table>{rows}</table></div>'
        f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'
        "<p>Non-orthogonality, skewness and aspect ratio are OpenFOAM's.</p>"
        f'<div class="histograms">{pictures}</div>'
    )


def _histogram(title: str, found: Mapping[str, Any]) -> str:
    edges, counts = found["histogram"]["edges"], found["histogram"]["counts"]
    most, width = max(*counts, 1), WIDTH / len(counts)
    bars = "".join(
        f'<rect x="{k * width:.1f}" y="{HEIGHT * (1 - count / most):.1f}" '
        f'width="{width - 1:.1f}" height="{HEIGHT * count / most:.1f}"/>'
        for k, count in enumerate(counts)
    )
    return (
        f'<figure><svg viewBox="0 0 {WIDTH} {HEIGHT + FOOT}" width="{WIDTH}" font-size="11" '
        f'fill="#4477aa" role="img" aria-label="{html.escape(title)}">{bars}'
        f'<text x="0" y="{HEIGHT + 13}" fill="currentColor">{edges[0]:.3g}</text>'
        f'<text x="{WIDTH}" y="{HEIGHT + 13}" fill="currentColor" text-anchor="end">'
        f"{edges[-1]:.3g}</text></svg><figcaption>{html.escape(title)}</figcaption></figure>"
    )
