"""Tables of figures, and the format of numbers and names."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

WORDS = {
    "as_written": "re-read from the file",
    "bad_edges": "edges not in two faces",
    "cd2": "CD²",
    "cpu_seconds": "CPU seconds",
    "cvt_iterations": "CVT steps",
    "cvt_loss_first": "CVT loss, first",
    "cvt_loss_last": "CVT loss, last",
    "crease_angle": "degrees from which the reference's edges are creases",
    "curvature_off_creases": "|H| away from creases",
    "dihedral_mean_curvature": "mean curvature by dihedral angles",
    "edge_f1": "edge F1",
    "f1": "F1",
    "from_reference_cd2": "CD² from the reference",
    "interface_faces": "faces of the diagram's interface",
    "intrusion": "deepest intrusion into a sphere, h²",
    "mask_overlap": "overlap with masks",
    "n_init": "voxels along the longest side",
    "p95": "95th percentile",
    "p99": "99th percentile",
    "pair_area_share": "share of the area between generator pairs",
    "pair_faces": "trained faces whose pair meets in the diagram",
    "reference_dihedral": "the reference's mean curvature by dihedral angles",
    "reference_creases": "the reference's own sharp edges",
    "reference_curvature_off_creases": "the reference's |H| away from creases",
    "resampled_curvature_off_creases": "|H| away from creases, evenly resampled",
    "residual_max": "sphere residual, largest, h²",
    "residual_rms": "sphere residual, rms, h²",
    "rms": "root mean square",
    "sdf_loss": "mean |F|",
    "sharp_angle": "degrees from which the surface's edges are sharp",
    "std": "standard deviation",
    "surface_cd2": "CD² from samples to the surface",
    "to_reference_cd2": "CD² to the reference",
}
"""Names that are clearer than the manifest's; all others only lose their underscores."""
LISTED = 8
"""Longer lists are counted, not written out."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float, digits: int = 4) -> str:
    """A number with separated thousands and raised powers of ten."""
    if isinstance(value, int):
        return f"{value:,}"
    text = f"{value:.{digits}g}"
    if "e" in text and 1 <= abs(value) < 1e6:
        return f"{value:,.0f}"
    if "e" in text:
        mantissa, _, power = text.partition("e")
        return f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    if abs(value) >= 10_000:
        return f"{value:,.0f}"
    return text.replace("-", "−")


def shown(value: Any, absent: str = "–") -> str:
    """A value of a manifest in words; ``absent`` stands for a missing one."""
    if value is None:
        return absent
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return number(value)
    if isinstance(value, (list, tuple)):
        if not value:
            return "none"
        if len(value) > LISTED or any(isinstance(item, (dict, list)) for item in value):
            return f"{len(value):,} entries"
        return ", ".join(shown(item) for item in value)
    return str(value)


def name(key: str) -> str:
    """The words for a key, dotted if it is inside others."""
    return ", ".join(WORDS.get(part, part.replace("_", " ")) for part in key.split("."))


def flat(value: Any, skip: Iterable[str] = (), prefix: str = "") -> list[tuple[str, Any]]:
    """All figures of nested dictionaries with their dotted keys."""
    if isinstance(value, dict):
        return [
            row
            for key, item in value.items()
            if key not in skip
            for row in flat(item, skip, f"{prefix}{key}.")
        ]
    return [(prefix.rstrip("."), value)]


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table that scrolls by itself where it is wider than the page; cells are HTML already.

    ``kind`` is a class; of ``numbers`` all columns but the first are numbers.
    """
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = "".join(
        '<tr><th scope="row">' + "</th>".join(row[:1]) + "</th>"
        + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>"
        for row in rows
    )  # fmt: skip
    heading = f"<thead><tr>{top}</tr></thead>" if any(head) else ""
    return (
        f'<div class="scroll"><table class="{kind}">{heading}<tbody>{lines}</tbody></table></div>'
    )


def facts(values: Mapping[str, Any], skip: Iterable[str] = (), absent: str = "–") -> str:
    """A table of a dictionary's figures, names in words; the manifest's own are in the tooltip."""
    rows = [
        (named(key), html.escape(shown(value, absent))) for key, value in flat(dict(values), skip)
    ]
    return table(("", ""), rows, "numbers") if rows else ""


def named(key: str) -> str:
    """HTML of a key's words, with the key itself as a tooltip."""
    return f'<span title="{html.escape(key)}">{html.escape(name(key))}</span>'


def verdict(held: Any) -> str:
    """HTML of how a check came out: bold, coloured, and in words."""
    if held is True:
        return '<b class="good">holds</b>'
    if held is False:
        return '<b class="bad">fails</b>'
    return html.escape(shown(held))
