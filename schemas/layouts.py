"""The HDF5 files of a run: which arrays, of what shape and type, in whose coordinates.

A dimension is a number, or a letter that stands for one size throughout a file; ``X+1`` is one
more than X. Positions and lengths are in the input's unit unless a line says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Layout:
    """One array: its shape, the kind of its values, and what it holds."""

    shape: tuple[str | int, ...]
    kind: str
    """f: float64, i: integer, b: bool."""
    meaning: str
    optional: bool = False


def _polygons(prefix: str, letter: str, meaning: str) -> dict[str, Layout]:
    vertices, faces, corners = f"V{letter}", f"F{letter}", f"S{letter}"
    return {
        f"{prefix}vertices": Layout((vertices, 3), "f", f"{meaning}: vertices"),
        f"{prefix}face_offsets": Layout((f"{faces}+1",), "i", "corners of face f: [f] to [f + 1]"),
        f"{prefix}face_vertices": Layout((corners,), "i", "vertex of each corner"),
    }


LAYOUTS: dict[str, dict[str, Layout]] = {
    "classify": {
        "origin": Layout((3,), "f", "lower corner of voxel (0, 0, 0)"),
        "spacing": Layout((), "f", "h0, edge of a voxel"),
        "interior": Layout(("X", "Y", "Z"), "b", "M_in"),
        "exterior": Layout(("X", "Y", "Z"), "b", "M_ext, the band outside"),
        "source/vertices": Layout(
            ("Vp", 3), "f", "of the surface made of the input", optional=True
        ),
        "source/triangles": Layout(
            ("Tp", 3), "i", "of the surface made of the input", optional=True
        ),
        "source/kept": Layout(("P",), "b", "points that do not lie out", optional=True),
        "source/noise": Layout((), "f", "standard deviation of the points", optional=True),
        "source/point_spacing": Layout((), "f", "typical spacing of the points", optional=True),
        "source/normals_agreement": Layout((), "f", "share of the given normals", optional=True),
        "source/missed": Layout((), "f", "share of the points off the surface", optional=True),
        "source/agreement": Layout(
            ("W",), "f", "of views: intersection over union of mask and surface", optional=True
        ),
    },
    "init": {
        "generators": Layout(("N", 3), "f", "generators"),
        "generator_inside": Layout(("N",), "b", "label of each generator"),
        "spacing": Layout(("N",), "f", "local spacing at each generator"),
        "history": Layout(("I", 4), "f", "shape, normal, area, centroid loss by iteration"),
        **_polygons("surface/", "s", "initial Voronoi surface"),
        "surface/face_generators": Layout(("Fs", 2), "i", "inside and outside generator"),
    },
    "baseline": {
        "generators": Layout(("N", 3), "f", "generators; the last eight bound the diagram"),
        "generator_inside": Layout(("N",), "b", "label of each generator"),
        "history": Layout(("I", 1), "f", "loss by epoch, squared and in the method's own frame"),
        **_polygons("surface/", "s", "interface of the generators' diagram"),
        "surface/face_generators": Layout(("Fs", 2), "i", "inside and outside generator"),
    },
    "sphere-train": {
        "spheres/center": Layout(("Vt", 3), "f", "c_v"),
        "spheres/radius": Layout(("Vt",), "f", "r_v"),
        **_polygons("trained/", "t", "polygons over the sphere centres"),
        "trained/offset": Layout(("Ft",), "f", "delta_f"),
        "generators/inside": Layout(("Ft", 3), "f", "inside generator of each trained face"),
        "generators/outside": Layout(("Ft", 3), "f", "outside generator of each trained face"),
        "spacing": Layout(("Ft",), "f", "local spacing at each trained face"),
        "history": Layout(("I", 4), "f", "intersection, exclusion, shape, smoothness by step"),
        **_polygons("surface/", "s", "the output: interface of the real diagram"),
        "surface/face_generators": Layout(
            ("Fs", 2), "i", "trained face whose inside, whose outside generator bounds it"
        ),
    },
    "shade": {
        **{
            f"shader/{name}.weight": Layout((out, into), "f", "weights, float32")
            for name, into, out in (
                ("position.0", 27, "K"),
                ("position.1", "K", "K"),
                ("colour.0", "K+6", "K"),
                ("colour.1", "K", "K"),
                ("colour.2", "K", 3),
            )
        },
        **{
            f"shader/{name}.bias": Layout((out,), "f", "biases, float32")
            for name, out in (
                ("position.0", "K"),
                ("position.1", "K"),
                ("colour.0", "K"),
                ("colour.1", "K"),
                ("colour.2", 3),
            )
        },
        "shader/centre": Layout((3,), "f", "the position that the network takes as the origin"),
        "shader/size": Layout((), "f", "the length that it takes as 1"),
        "history": Layout(("I", 1), "f", "loss by step"),
    },
    "volume": {
        "generators": Layout(("N", 3), "f", "generators"),
        "generator_role": Layout(("N",), "i", "0 outside, 1 surface, 2 inner"),
        **_polygons("", "v", "cells; the surface's own ones first"),
        "face_owner": Layout(
            ("Fv",), "i", "cell the face's normal leaves; sorted, faces of the surface last"
        ),
        "face_neighbour": Layout(("Fv",), "i", "cell on the other side, -1 outside"),
        "cell_generator": Layout(("C",), "i", "generator of each cell"),
        "cell_volume": Layout(("C",), "f", "volume of each cell"),
        "history": Layout(("I",), "f", "CVT loss by iteration"),
    },
    "evaluate": {
        **_polygons("surface/", "s", "the surface that was measured"),
        "vertex_distance": Layout(("Vs",), "f", "distance to the nearest reference sample"),
        "mean_curvature": Layout(("Vs",), "f", "|H|, nan without a valid fit"),
    },
    "fabricate": {
        "nodes": Layout(("K", 3), "f", "ends of tube axes, millimetres"),
        "tubes": Layout(("E", 2), "i", "nodes of each tube"),
        "radii": Layout(("K",), "f", "tube radius at each node, millimetres"),
        "plates": Layout(("P",), "i", "faces that became plates"),
        "mm_from_input": Layout((4, 4), "f", "maps the input's coordinates to millimetres"),
    },
}


def check(stage: str, arrays: Mapping[str, Any]) -> None:
    """Raise ValueError unless ``arrays`` are laid out as ``stage`` says; more arrays may be there.

    Integers that index another array are checked to be in range.
    """
    sizes: dict[str, int] = {}
    for name, layout in LAYOUTS[stage].items():
        if name not in arrays:
            if layout.optional:
                continue
            raise ValueError(f"array {name} is missing")
        array = np.asarray(arrays[name])
        if array.dtype.kind not in {"f": "f", "i": "iu", "b": "b"}[layout.kind]:
            raise ValueError(f"array {name} holds {array.dtype}")
        if array.ndim != len(layout.shape):
            raise ValueError(f"array {name} has {array.ndim} dimensions")
        for size, dimension in zip(array.shape, layout.shape, strict=True):
            wanted = dimension
            if isinstance(dimension, str):
                letter, _, more = dimension.partition("+")
                wanted = sizes.setdefault(letter, size - int(more or 0)) + int(more or 0)
            if size != wanted:
                raise ValueError(f"array {name} has shape {array.shape}")
    for name in LAYOUTS[stage]:
        if not name.endswith("face_offsets"):
            continue
        prefix = name[: -len("face_offsets")]
        offsets, corners = np.asarray(arrays[name]), np.asarray(arrays[prefix + "face_vertices"])
        if offsets[0] != 0 or offsets[-1] != len(corners) or (np.diff(offsets) < 0).any():
            raise ValueError(f"array {name} is no row index")
        count = len(arrays[prefix + "vertices"])
        if len(corners) and (corners.min() < 0 or corners.max() >= count):
            raise ValueError(f"array {prefix}face_vertices names a vertex that is not there")
