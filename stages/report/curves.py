"""Curves and histograms as SVG, which scale, print, and use the colours of the page."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

from ..artifacts.run_folder import RunFolder
from ..mesh.polygons import Floats
from .surfaces import MODES, Shape
from .tables import number

TERMS = {
    "init": ("shape", "normal", "area", "centroid"),
    "sphere-train": ("intersection", "exclusion", "shape", "smoothness"),
    "volume": ("centroid",),
    "shade": ("colour",),
}
"""Names of the columns of each stage's history."""
TITLES = {"init": "Initial surface", "sphere-train": "Training of the spheres",
          "volume": "Evening out of the cells", "shade": "Appearance"}  # fmt: skip
LEAST = 1e-12
WIDTH, HEIGHT, LEFT, FOOT = 420, 200, 44, 34
BARS = 40
FIGURE_WIDTH, FIGURE_HEIGHT = 240, 90


def losses(folder: RunFolder) -> str:
    """HTML of the losses by iteration, stage by stage."""
    figures = []
    for stage, terms in TERMS.items():
        if folder.manifest(stage) is None:
            continue
        history = folder.arrays(stage, stage)["history"]
        if len(history) > 1:
            figures.append(_curves(TITLES[stage], history.reshape(len(history), -1), terms))
    if not figures:
        return ""
    return f'<h2>Losses</h2><div class="figures">{"".join(figures)}</div>'


def _curves(title: str, history: Floats, terms: Sequence[str]) -> str:
    """One stage's losses over its steps, on a logarithmic scale."""
    used = [k for k in range(min(len(terms), history.shape[1])) if (history[:, k] > LEAST).any()]
    if not used:
        return ""
    logs = np.log10(np.maximum(history[:, used], LEAST))
    low, high = np.floor(logs.min()), max(np.ceil(logs.max()), np.floor(logs.min()) + 1)
    x = np.linspace(LEFT, WIDTH - 8, len(logs))
    y = 10 + (HEIGHT - 10) * (high - logs) / (high - low)
    every = max(1, int((high - low) // 5))
    grid = []
    for power in np.arange(low, high + 1, every):
        at = 10 + (HEIGHT - 10) * (high - power) / (high - low)
        grid.append(
            f'<line x1="{LEFT}" x2="{WIDTH - 8}" y1="{at:.1f}" y2="{at:.1f}"/>'
            f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">'
            f"{number(10.0**power, 1)}</text>"
        )
    lines, keys = [], []
    for column, k in enumerate(used):
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y[:, column], strict=True))
        lines.append(f'<polyline class="curve c{k}" points="{points}"/>')
        keys.append(f'<span class="key c{k}">{html.escape(terms[k])}</span>')
    steps = len(history) - 1
    return (
        f'<figure><figcaption>{html.escape(title)}</figcaption><svg class="chart" '
        f'viewBox="0 0 {WIDTH} {HEIGHT + FOOT}" role="img" '
        f'aria-label="Losses of {html.escape(title)}"><g class="grid">{"".join(grid)}</g>'
        f'<text x="{LEFT}" y="{HEIGHT + 18}">0</text>'
        f'<text x="{WIDTH - 8}" y="{HEIGHT + 18}" text-anchor="end">step {steps:,}</text>'
        f'{"".join(lines)}</svg><p class="keys">{"".join(keys)}</p></figure>'
    )


def histogram(title: str, edges: Sequence[float], counts: Sequence[float], more: str = "") -> str:
    """HTML of one histogram, with the ends of its range under it."""
    most, width = max(*counts, 1), FIGURE_WIDTH / len(counts)
    bars = "".join(
        f'<rect x="{k * width:.1f}" y="{FIGURE_HEIGHT * (1 - count / most):.1f}" '
        f'width="{max(width - 1, 1):.1f}" height="{FIGURE_HEIGHT * count / most:.1f}"/>'
        for k, count in enumerate(counts)
        if count
    )
    about = f"<small>{html.escape(more)}</small>" if more else ""
    return (
        f'<figure class="bars"><figcaption>{html.escape(title)}{about}</figcaption>'
        f'<svg viewBox="0 0 {FIGURE_WIDTH} {FIGURE_HEIGHT + 18}" role="img" '
        f'aria-label="{html.escape(title)}">{bars}<line x1="0" x2="{FIGURE_WIDTH}" '
        f'y1="{FIGURE_HEIGHT}" y2="{FIGURE_HEIGHT}"/><text x="0" y="{FIGURE_HEIGHT + 14}">'
        f'{number(edges[0], 3)}</text><text x="{FIGURE_WIDTH}" y="{FIGURE_HEIGHT + 14}" '
        f'text-anchor="end">{number(edges[-1], 3)}</text></svg></figure>'
    )


def distributions(shapes: Sequence[Shape]) -> str:
    """HTML of histograms of the values that colour the surfaces, without the input and the cut."""
    groups = []
    for mode, (title, unit) in MODES.items():
        figures = []
        found = [
            (shape, shape.fields[mode].values)
            for shape in shapes
            if mode in shape.fields and shape.key not in ("input", "cut")
        ]
        known = [(shape, values[np.isfinite(values)]) for shape, values in found]
        known = [(shape, values) for shape, values in known if len(values)]
        if not known:
            continue
        # One range for all surfaces, so that they can be compared.
        low = min(float(np.percentile(values, 0.5)) for _, values in known)
        high = max(float(np.percentile(values, 99)) for _, values in known)
        if not high > low:
            high = low + max(abs(low), LEAST)
        edges = np.linspace(low, high, BARS + 1)
        for shape, values in known:
            counts = np.histogram(np.clip(values, low, high), edges)[0]
            more = f"median {number(float(np.median(values)), 3)}"
            more += f", 95th percentile {number(float(np.percentile(values, 95)), 3)}"
            figures.append(histogram(shape.title, edges.tolist(), counts.tolist(), more))
        groups.append(
            f"<h3>{html.escape(title)} <small>{html.escape(unit)}</small></h3>"
            f'<div class="figures">{"".join(figures)}</div>'
        )
    if not groups:
        return ""
    return (
        f"<h2>Distributions</h2>{''.join(groups)}"
        '<p class="help">The last bar holds what lies beyond the 99th percentile.</p>'
    )
