"""The layouts of the HDF5 files of a run: the arrays with their shapes, types and coordinates.

A dimension is a number, or a letter that stands for the same size throughout a file; ``X+1`` is one
more than X. Positions and lengths are in the unit of the input unless a line says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

HUGE = 1e100
"""Upper bound of lengths and coordinates, so that their powers are finite."""
TINY = 1e-300
"""Lower bound of lengths and other values that must be positive."""


@dataclass(frozen=True)
class Layout:
    """The layout of one array: its shape, the type of its values, and their meaning."""

    shape: tuple[str | int, ...]
    kind: str
    """f for float64, i for integers, b for bool."""
    meaning: str
    optional: bool = False
    into: str | None = None
    """For indices: the letter of the size of the array to which they refer."""
    least: float | None = None
    """The smallest value that is allowed; 0 for indices."""
    most: float | None = None
    undefined: bool = False
    """Whether nan is allowed where there is no value."""


def _polygons(prefix: str, letter: str, meaning: str) -> dict[str, Layout]:
    vertices, faces, corners = f"V{letter}", f"F{letter}", f"S{letter}"
    return {
        f"{prefix}vertices": Layout((vertices, 3), "f", f"{meaning}: vertices"),
        f"{prefix}face_offsets": Layout((f"{faces}+1",), "i", "corners of face f: [f] to [f + 1]"),
        f"{prefix}face_vertices": Layout((corners,), "i", "vertex of each corner", into=vertices),
    }


LAYOUTS: dict[str, dict[str, Layout]] = {
    "classify": {
        "origin": Layout((3,), "f", "lower corner of voxel (0, 0, 0)"),
        "spacing": Layout((), "f", "h0, edge of a voxel", least=TINY),
        "interior": Layout(("X", "Y", "Z"), "b", "M_in"),
        "exterior": Layout(("X", "Y", "Z"), "b", "M_ext, the band outside"),
        "source/vertices": Layout(
            ("Vp", 3), "f", "of the surface made of the input", optional=True
        ),
        "source/triangles": Layout(
            ("Tp", 3), "i", "of the surface made of the input", optional=True, into="Vp"
        ),
        "source/whole": Layout(
            (), "b", "whether the mesh is closed and taken as it is", optional=True
        ),
        "source/kept": Layout(("P",), "b", "points that do not lie out", optional=True),
        "source/noise": Layout(
            (), "f", "standard deviation of the points", optional=True, undefined=True
        ),
        "source/point_spacing": Layout(
            (), "f", "typical spacing of the points", optional=True, undefined=True
        ),
        "source/normals_agreement": Layout(
            (), "f", "share of the given normals", optional=True, undefined=True
        ),
        "source/missed": Layout(
            (), "f", "share of the points off the surface", optional=True, undefined=True
        ),
        "source/columns": Layout(
            ("K",), "i", "columns of a text that hold the points, from 1 on", optional=True
        ),
        "source/level": Layout((), "f", "of samples: what is above it is inside", optional=True),
        "source/inverted": Layout((), "b", "of views: the object is dark in masks", optional=True),
        "source/openings": Layout(
            (), "b", "of views: enclosed areas of the background are background", optional=True
        ),
        "source/background": Layout(
            (3,), "i", "of views: colour of the background", optional=True, least=0, most=255
        ),
        "source/scale": Layout(
            ("W",), "f", "of views: what a picture is scaled by", optional=True, least=TINY
        ),
        "source/shift": Layout(
            ("W", 2), "f", "of views: right and down, as a share of the width", optional=True
        ),
        "source/agreement": Layout(
            ("W",), "f", "of views: intersection over union of mask and surface", optional=True
        ),
    },
    "init": {
        "generators": Layout(("N", 3), "f", "generators"),
        "generator_inside": Layout(("N",), "b", "label of each generator"),
        "spacing": Layout(("N",), "f", "local spacing at each generator", least=TINY),
        "history": Layout(("I", 4), "f", "shape, normal, area, centroid loss by iteration"),
        **_polygons("surface/", "s", "initial Voronoi surface"),
        "surface/face_generators": Layout(("Fs", 2), "i", "inside and outside generator", into="N"),
    },
    "baseline": {
        "generators": Layout(("N", 3), "f", "generators; the last eight bound the diagram"),
        "generator_inside": Layout(("N",), "b", "label of each generator"),
        "history": Layout(("I", 1), "f", "loss by epoch, squared and in the method's own frame"),
        **_polygons("surface/", "s", "interface of the generators' diagram"),
        "surface/face_generators": Layout(("Fs", 2), "i", "inside and outside generator", into="N"),
    },
    "sphere-train": {
        "spheres/center": Layout(("Vt", 3), "f", "c_v"),
        "spheres/radius": Layout(("Vt",), "f", "r_v", least=TINY),
        **_polygons("trained/", "t", "polygons over the sphere centres"),
        "trained/offset": Layout(("Ft",), "f", "delta_f"),
        "generators/inside": Layout(("Ft", 3), "f", "inside generator of each trained face"),
        "generators/outside": Layout(("Ft", 3), "f", "outside generator of each trained face"),
        "spacing": Layout(("Ft",), "f", "local spacing at each trained face", least=TINY),
        "history": Layout(("I", 4), "f", "intersection, exclusion, shape, smoothness by step"),
        **_polygons("surface/", "s", "the output: interface of the real diagram"),
        "surface/face_generators": Layout(
            ("Fs", 2),
            "i",
            "trained face whose inside, whose outside generator bounds it",
            into="Ft",
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
        "generator_role": Layout(("N",), "i", "0 outside, 1 surface, 2 inner", least=0, most=2),
        **_polygons("", "v", "cells; the surface's own ones first"),
        "face_owner": Layout(
            ("Fv",),
            "i",
            "cell the face's normal leaves; sorted, faces of the surface last",
            into="C",
        ),
        "face_neighbour": Layout(
            ("Fv",), "i", "cell on the other side, -1 outside", into="C", least=-1
        ),
        "cell_generator": Layout(("C",), "i", "generator of each cell", into="N"),
        "cell_volume": Layout(("C",), "f", "volume of each cell"),
        "history": Layout(("I",), "f", "CVT loss by iteration"),
    },
    "evaluate": {
        **_polygons("surface/", "s", "the surface that was measured"),
        "vertex_distance": Layout(("Vs",), "f", "distance to the nearest reference sample"),
        "mean_curvature": Layout(("Vs",), "f", "|H|, nan without a valid fit", undefined=True),
    },
    "fabricate": {
        "nodes": Layout(("K", 3), "f", "ends of tube axes, millimetres"),
        "tubes": Layout(("E", 2), "i", "nodes of each tube", into="K"),
        "radii": Layout(("K",), "f", "tube radius at each node, millimetres", least=0.0),
        "plates": Layout(("P",), "i", "faces that became plates", least=0),
        "mm_from_input": Layout((4, 4), "f", "maps the input's coordinates to millimetres"),
    },
}


def check_shapes(
    layout: Mapping[str, Layout], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, int]:
    """The sizes for the letters. Raises ValueError if an array is missing or
    its shape does not fit."""
    sizes: dict[str, int] = {}
    for name, wanted in layout.items():
        if name not in shapes:
            if wanted.optional:
                continue
            raise ValueError(f"array {name} is missing")
        shape = shapes[name]
        if len(shape) != len(wanted.shape):
            raise ValueError(f"array {name} has {len(shape)} dimensions")
        for size, dimension in zip(shape, wanted.shape, strict=True):
            needed = dimension
            if isinstance(dimension, str):
                letter, _, more = dimension.partition("+")
                needed = sizes.setdefault(letter, size - int(more or 0)) + int(more or 0)
            if size != needed or (isinstance(dimension, str) and sizes[letter] < 0):
                raise ValueError(f"array {name} has shape {shape}")
    return sizes


def check(stage: str, arrays: Mapping[str, Any]) -> None:
    """Raise ValueError if ``arrays`` do not have the layout of ``stage``. Further arrays are
    allowed.

    Indices must be in range. Numbers must be finite and not below their smallest value.
    """
    layout = LAYOUTS[stage]
    found = {name: np.asarray(arrays[name]) for name in layout if name in arrays}
    sizes = check_shapes(layout, {name: array.shape for name, array in found.items()})
    for name, array in found.items():
        wanted = layout[name]
        if array.dtype.kind not in {"f": "f", "i": "iu", "b": "b"}[wanted.kind]:
            raise ValueError(f"array {name} holds {array.dtype}")
        if array.size == 0 or wanted.kind == "b":
            continue
        values = array[~np.isnan(array)] if wanted.undefined else array
        if not np.isfinite(values).all() or (wanted.kind == "f" and (abs(values) > HUGE).any()):
            raise ValueError(f"array {name} holds values that are not finite, or past all use")
        least = 0 if wanted.into is not None and wanted.least is None else wanted.least
        most = wanted.most if wanted.into is None else sizes[wanted.into] - 1
        low, high = (values.min(), values.max()) if values.size else (0, 0)
        if (least is not None and low < least) or (most is not None and high > most):
            said = "names a row that is not there" if wanted.into else "is out of range"
            raise ValueError(f"array {name} {said} ({low} to {high})")
    for name, offsets in found.items():
        if name.endswith("face_offsets"):
            corners = found[name[: -len("face_offsets")] + "face_vertices"]
            if offsets[0] != 0 or offsets[-1] != len(corners) or (np.diff(offsets) < 0).any():
                raise ValueError(f"array {name} is no row index")
