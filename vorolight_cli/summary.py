"""A finished stage in a few lines on the terminal."""

from __future__ import annotations

from typing import Any

from .console import Console, table


def _number(value: float | None) -> str:
    return "not run" if value is None else f"{value:.4g}"


def _surface(topology: dict[str, Any]) -> str:
    closed = (
        "closed"
        if topology["bad_edges"] == 0
        else f"not closed ({topology['bad_edges']} edges are not in two faces)"
    )
    parts = topology["components"]
    return (
        f"{topology['faces']} faces, {closed}, Euler number {topology['euler_number']}, "
        f"{parts} component{'s' if parts != 1 else ''}"
    )


def _object(metrics: dict[str, Any]) -> str:
    written = metrics["as_written"]
    parts = "".join(
        f"{metrics[key]} {key}, " for key in ("tubes", "plates", "cells") if key in metrics
    )
    text = f"{metrics['mode']}: {parts}{written['size_mm'][2]:.1f} mm high, re-read: watertight, "
    text += "1 body" if written["bodies"] == 1 else f"{written['bodies']} bodies"
    sliced = written.get("slicer")
    if sliced:
        text += f"; sliced: {sliced['layers']} layers, {sliced['filament_g']:.0f} g"
        text += f", {sliced['printing_time']}"
    return text


def of(manifest: dict[str, Any], console: Console) -> str:
    """One line for a stage, a table for an evaluation."""
    stage, metrics = manifest["stage"], manifest["metrics"]
    seconds = f"{manifest['volatile']['wall_seconds']:.1f} s"
    text = {
        "classify": lambda: (
            f"{metrics['interior_voxels']} interior voxels of edge {metrics['spacing']:.4g}; up to "
            f"the surface about {metrics['effort']['triangles']:,} triangles and "
            f"{metrics['effort']['cpu_seconds']:.0f} CPU seconds"
        ),
        "init": lambda: f"{metrics['generators']} generators, {_surface(metrics['topology'])}",
        "sphere-train": lambda: (
            f"{metrics['trained_faces']} trained faces; surface: {_surface(metrics['topology'])}; "
            + (
                "certificate holds"
                if metrics["certificate"]["holds"]
                else f"no certificate, {100 * metrics['conformity']['pair_area_share']:.2f} % of "
                "the area lies between generator pairs"
            )
        ),
        "volume": lambda: (
            f"{metrics['cells']} cells, {sum(metrics['faults'].values())} of them faulty, "
            f"{metrics['changed_faces'] or 'no'} faces of the surface changed, volume "
            f"{metrics['cell_volume_sum']:.6g}; mean distance of generators to centroids "
            f"{100 * metrics['centroid_distance_mean']:.2g} % of the cell size"
        ),
        "shade": lambda: (
            f"trained on {metrics['trained_views']} views; PSNR of "
            f"{len(metrics['held_out_views'])} other views: {_number(metrics['held_out_psnr'])} dB"
        ),
        "evaluate": lambda: f"surface of {metrics['of']}",
        "fabricate": lambda: _object(metrics),
        "baseline": lambda: (
            f"{metrics['method']}, {metrics['generators']} generators, "
            f"{_surface(metrics['topology'])}"
        ),
    }[stage]()
    line = f"{console.strong(stage)}: {text} ({seconds})"
    return line if stage != "evaluate" else f"{line}\n{evaluation_table(metrics)}"


def evaluation_rows(metrics: dict[str, Any]) -> list[tuple[str, ...]]:
    """Name, value and reference of every figure of an evaluation."""
    distances, truth = metrics["chamfer"], metrics["reference_curvature"] or {}
    bent, close = metrics["curvature"] or {}, metrics["fidelity"]
    topology, expected = metrics["topology"], metrics["expected_topology"] or {}
    rows: list[tuple[str, ...]] = [
        ("figure", "surface", "reference"),
        ("CD^2 x 1e3", _number(distances["cd2"] * 1e3),
         f"sampling floor {distances['sampling_floor'] * 1e3:.4g}"),
        (f"F1@{metrics['protocol']['threshold']:g}", _number(distances["f1"]), "1"),
        ("sample-to-surface CD^2 x 1e3", _number(close["surface_cd2"] * 1e3), "0"),
        ("normal consistency", _number(close["normal_consistency"]), "1"),
        ("dihedral mean curvature", _number(metrics["dihedral_mean_curvature"]),
         "" if metrics["reference_dihedral"] is None else _number(metrics["reference_dihedral"])),
    ]  # fmt: skip
    for key, name in (("mean", "mean |H|"), ("std", "std |H|"), ("median", "median |H|"),
                      ("p95", "P95 |H|"), ("valid_share", "valid share of |H|")):  # fmt: skip
        shown = "" if truth.get(key) is None else _number(truth[key])
        rows.append((name, _number(bent.get(key)), shown))
    even = metrics["resampled_curvature"] or {}
    for key, name in (("mean", "mean"), ("p95", "P95")):
        rows.append((f"{name} |H|, evenly resampled", _number(even.get(key)), ""))
    if metrics["creases"] is not None:
        edges, smooth, even, truth = (
            metrics[key] or {}
            for key in ("creases", "curvature_off_creases", "resampled_curvature_off_creases",
                        "reference_curvature_off_creases")
        )  # fmt: skip
        aim = "" if not truth else _number(truth["mean"])
        # The angle of a crease may cross both thresholds along it; the reference itself shows how
        # often.
        own = metrics["reference_creases"] or dict.fromkeys(
            ("edge_f1", "edge_precision", "edge_recall"), 1.0
        )
        rows += [
            ("mean |H|, away from creases", _number(smooth.get("mean")), aim),
            ("mean |H|, also evenly resampled", _number(even.get("mean")), aim),
            (f"edge F1@{edges['tolerance']:g}", _number(edges["edge_f1"]), _number(own["edge_f1"])),
            ("edge precision, recall",
             *(f"{_number(of['edge_precision'])}, {_number(of['edge_recall'])}"
               for of in (edges, own))),
            ("creases to sharp edges, median, h0", _number(edges["distance_median"]), "0"),
            ("creases to sharp edges, P99, h0", _number(edges["distance_p99"]), "0"),
        ]  # fmt: skip
    if metrics["sdf_loss"] is not None:
        rows.append(("mean |F|", _number(metrics["sdf_loss"]), "0"))
    if metrics["mask_overlap"] is not None:
        overlap = metrics["mask_overlap"]
        rows.append(("overlap with masks, mean", _number(overlap["mean"]), "1"))
        rows.append(("overlap with masks, worst", _number(overlap["worst"]), "1"))
    rows += [
        ("faces", str(topology["faces"]), ""),
        ("Euler number", str(topology["euler_number"]), str(expected.get("euler_number", ""))),
        ("components", str(topology["components"]), str(expected.get("components", ""))),
    ]
    for gate, held in metrics["gates"].items():
        if gate == "certificate":  # it is listed below, with the conditions that fail
            continue
        words = held if isinstance(held, str) else "yes" if held else "no"
        rows.append((gate.replace("_", " "), words, ""))
    if "conformity" in metrics:
        conformity, trained = metrics["conformity"], metrics["trained"]
        faces = f"{conformity['interface_faces']}, {conformity['trained_faces']}"
        certificate = metrics["certificate"]
        failed = "fails: " + ", ".join(certificate["failed"])
        rows += [
            ("certificate", "holds" if certificate["holds"] else failed, ""),
            ("pair area share", _number(conformity["pair_area_share"]), "1"),
            ("faces of the diagram before merging, trained", faces, ""),
            ("sphere residual, rms in h^2", _number(conformity["residual_rms"]), "0"),
            ("deepest intrusion in h^2", _number(conformity["intrusion"]), "0"),
        ]
        bent = trained["curvature"] or {}
        rows.append(("mean |H|, trained polygons", _number(bent.get("mean")), ""))
        if trained["sdf_loss"] is not None:
            rows.append(("mean |F|, trained polygons", _number(trained["sdf_loss"]), "0"))
    return rows


def evaluation_table(metrics: dict[str, Any]) -> str:
    protocol, fits = metrics["protocol"], metrics["curvature_settings"]
    changed = f" (changed: {', '.join(protocol['changed'])})" if protocol["changed"] else ""
    return (
        f"{table(evaluation_rows(metrics))}\n"
        f"protocol {protocol['name']}{changed}: {protocol['samples']} samples, F1 at "
        f"{protocol['threshold']:g}, {protocol['frame']} ({protocol['diagonal']:.4g}); |H| by "
        f"fits of radius {fits['radius']:.4g}, twice the {fits['h_ref_is']}, at least "
        f"{fits['minimum_neighbours']} neighbours, condition at most {fits['condition_limit']:g}"
    )
