"""Sections of the report on the quality of surfaces: evaluations, conformity, gates."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from ..artifacts.manifest import Manifest
from ..voronoi.certificate import MARGIN, TAU
from .tables import facts, name, named, number, table, verdict

Evaluations = Mapping[str, Manifest]
FIGURES = (
    ("chamfer.cd2", "CD² × 1000, between samples", "chamfer.sampling_floor", 1e3),
    ("fidelity.surface_cd2", "CD² × 1000, samples to the surface", 0.0, 1e3),
    ("chamfer.f1", "F1", 1.0, 1),
    ("chamfer.precision", "precision", 1.0, 1),
    ("chamfer.recall", "recall", 1.0, 1),
    ("fidelity.normal_consistency", "normal consistency", 1.0, 1),
    ("creases.edge_f1", "edge F1, sharp edges and creases", 1.0, 1),
    ("creases.edge_precision", "edge precision", 1.0, 1),
    ("creases.edge_recall", "edge recall", 1.0, 1),
    ("creases.distance_median", "from creases to sharp edges, median, h0", 0.0, 1),
    ("creases.distance_p99", "from creases to sharp edges, 99th percentile, h0", 0.0, 1),
    ("curvature.mean", "mean |H|", "reference_curvature.mean", 1),
    ("curvature.median", "median |H|", "reference_curvature.median", 1),
    ("curvature.p95", "95th percentile of |H|", "reference_curvature.p95", 1),
    ("resampled_curvature.mean", "mean |H|, evenly resampled", "reference_curvature.mean", 1),
    ("curvature_off_creases.mean", "mean |H| away from creases",
     "reference_curvature_off_creases.mean", 1),
    ("resampled_curvature_off_creases.mean", "mean |H| away from creases, evenly resampled",
     "reference_curvature_off_creases.mean", 1),
    ("dihedral_mean_curvature", "mean curvature by dihedral angles", "reference_dihedral", 1),
    ("sdf_loss", "mean |F|", 0.0, 1),
    ("mask_overlap.mean", "overlap with masks, mean", 1.0, 1),
    ("mask_overlap.worst", "overlap with masks, worst", 1.0, 1),
    ("topology.faces", "faces", None, 1),
    ("topology.euler_number", "Euler number", "expected_topology.euler_number", 1),
    ("topology.components", "components", "expected_topology.components", 1),
    ("topology.bad_edges", "edges not in two faces", 0, 1),
    ("topology.pinched_vertices", "pinched vertices", 0, 1),
)  # fmt: skip
"""Key in an evaluation, its name, its ideal (a number, or the key of the reference's value), and
the factor with which it is shown."""
CONDITIONS = {
    "incident": ("every generator lies on the spheres of its face's corners",
                 "incident_power", f"at most {TAU:g} h²"),
    "exclusion": ("no generator lies inside any other sphere", "margin", f"at least {MARGIN:g} h²"),
    "rings": ("faces are convex, planar polygons, edges are in two faces", "bad_rings", "0"),
    "orientation": ("normals point from the inside to the outside generator", "turned_faces", "0"),
    "winding": ("the surface winds once around every inside generator", "wound_wrongly", "0"),
}  # fmt: skip
"""The conditions of the certificate: their meaning, the value found, and the value required."""


def value_of(metrics: Mapping[str, Any], key: str) -> Any:
    """The figure at a dotted key, None if it is missing."""
    found: Any = metrics
    for part in key.split("."):
        if not isinstance(found, Mapping) or found.get(part) is None:
            return None
        found = found[part]
    return found


def evaluations(found: Evaluations) -> str:
    """HTML of the evaluations side by side."""
    if not found:
        return ""
    rows = []
    for key, title, ideal, factor in FIGURES:
        values = [value_of(manifest["metrics"], key) for manifest in found.values()]
        if all(value is None for value in values):
            continue
        aims = [
            value_of(manifest["metrics"], ideal) if isinstance(ideal, str) else ideal
            for manifest in found.values()
        ]
        aim = next((aim for aim in aims if aim is not None), None)
        label = f'<span title="{key}">{html.escape(title)}</span>'
        cells = [scaled(value, factor) for value in values]
        rows.append((label, *cells, scaled(aim, factor) if aim is not None else ""))
    first = next(iter(found.values()))["metrics"]["protocol"]
    head = ("", *(html.escape(stem.removeprefix("evaluate-")) for stem in found), "ideal")
    about = (
        f"{first['samples']:,} samples on each surface; {first['frame']}. Ideal values: for "
        "CD² between samples, what two samplings of one surface give; for curvature, that "
        "of the reference."
    )
    details = "".join(
        f"<details><summary>All figures of {html.escape(stem)}</summary>"
        f"{facts(manifest['metrics'], ('histogram', 'gates', 'of'))}</details>"
        for stem, manifest in found.items()
    )
    return (
        f"<h2>Quality of the surfaces</h2>{table(head, rows, 'numbers')}"
        f'<p class="help">{html.escape(about)}</p>{details}'
    )


def scaled(value: Any, factor: float) -> str:
    """A figure as it is shown: integers stay integers."""
    if value is None:
        return "–"
    return number(value if factor == 1 else float(factor * value))


def conformity(manifests: Mapping[str, Manifest]) -> str:
    """HTML of the certificate's conditions, from the files as re-read if possible."""
    source = next(
        (stem for stem in ("evaluate-sphere-train", "evaluate-volume", "sphere-train")
         if (manifests.get(stem) or {"metrics": {}})["metrics"].get("certificate")), None
    )  # fmt: skip
    if source is None:
        return ""
    metrics = manifests[source]["metrics"]
    certificate = metrics["certificate"]
    rows = [
        (
            f'<span title="{key}">{html.escape(meaning)}</span>',
            verdict(key not in certificate["failed"]),
            scaled(certificate.get(figure), 1),
            html.escape(wanted),
        )
        for key, (meaning, figure, wanted) in CONDITIONS.items()
    ]
    rows.append(("<b>the certificate</b>", verdict(bool(certificate["holds"])), "", ""))
    of = "as trained" if source == "sphere-train" else "recomputed from the files"
    return (
        f"<h2>Conformity <small>{of}</small></h2>"
        "<p>If all five conditions hold, the trained faces are the interface of the Voronoi "
        "diagram of their generators, all of it and nothing else.</p>"
        f"{table(('condition', '', 'found', 'required'), rows, 'words')}"
        f"{facts(metrics.get('conformity') or {})}"
    )


def gates(found: Evaluations) -> str:
    """HTML of the gates of each evaluation."""
    keys = list(dict.fromkeys(key for m in found.values() for key in m["metrics"]["gates"]))
    if not keys:
        return ""
    rows = [
        (named(key), *(verdict(m["metrics"]["gates"].get(key)) for m in found.values()))
        for key in keys
    ]
    head = ("", *(html.escape(name(stem.removeprefix("evaluate-"))) for stem in found))
    return f"<h2>Gates</h2>{table(head, rows, 'words')}"
