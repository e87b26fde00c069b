"""The surfaces of a run, and the values that colour them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..artifacts.hdf5 import Arrays
from ..artifacts.manifest import Manifest
from ..artifacts.run_folder import RunFolder
from ..errors import InputError
from ..inputs.resolve import identify_path
from ..mesh.geometry import face_frames, face_sums
from ..mesh.polygons import Floats, PolygonMesh
from .pictures import INNER, PRINT, SURFACE, cut_open, printed
from .simplify import TRIANGLES, clustered, simplified, thinned, voxel_surface

INPUT = np.array([0.80, 0.78, 0.72])
POINTS = 60_000
"""Number of points of a cloud that are drawn."""
MODES = {
    "error": ("Distance to the reference", "with its bounding-box diagonal as 1"),
    "curvature": ("Mean curvature |H|", "1 / unit of the input"),
    "residual": ("Sphere residual of the face", "h²"),
    "size": ("Face area", "h²"),
}
"""Name and unit of the values that can colour a surface; h is the edge of a voxel."""


@dataclass(frozen=True)
class Values:
    """A number for every vertex or every face; NaN where it is not known."""

    per: Literal["vertex", "face"]
    values: Floats


@dataclass
class Shape:
    """One entry of the view: polygons, or points."""

    key: str
    title: str
    stage: str
    mesh: PolygonMesh | None
    points: Floats | None = None
    colour: Floats = field(default_factory=lambda: SURFACE)
    second: Floats = field(default_factory=lambda: INNER)
    tint: NDArray[np.bool_] | None = None
    """Faces in the second colour."""
    fields: dict[str, Values] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    """Why a colouring is missing."""
    note: str = ""
    edges: bool = True


@dataclass
class Collected:
    """The shapes of a run, in the order of its stages, and those that could not be shown."""

    shapes: list[Shape]
    left_out: list[str]


def collect(folder: RunFolder) -> Collected:
    """Everything of a run that can be drawn.

    Raises ArtifactError if a file of a finished stage is missing or damaged.
    """
    found = Collected([], [])
    first = folder.manifest("classify")
    spacing = None
    if first is not None:
        grid = folder.arrays("classify", "classify")
        spacing = float(grid["spacing"])
        found.shapes += _inputs(folder, first, grid, found.left_out)
        found.shapes += _voxels(grid)
    for shape in _stages(folder):
        _colourings(folder, shape, spacing)
        found.shapes.append(shape)
    found.shapes += _object(folder)
    for shape in found.shapes:
        for mode, (title, _) in MODES.items():
            if mode not in shape.fields:
                reason = f"{title} is not a property of {shape.title[0].lower()}{shape.title[1:]}."
                shape.missing.setdefault(mode, reason)
    return found


def _inputs(
    folder: RunFolder, manifest: Manifest, grid: Arrays, left_out: list[str]
) -> Iterator[Shape]:
    """The input, and the surface that classify made of it."""
    entry = manifest["inputs"][0]
    try:
        if entry["kind"] == "mesh":
            yield _mesh(_same(folder, entry))
        elif entry["kind"] == "points":
            columns = ",".join(map(str, grid["source/columns"])) or None
            yield _cloud(_same(folder, entry), columns)
        elif entry["kind"] == "field":
            left_out.append("The input is a field, which has no faces to draw.")
    except InputError as error:
        left_out.append(f"The input is left out: {error}.")
    if "source/vertices" in grid:
        mesh = PolygonMesh.of_triangles(grid["source/vertices"], grid["source/triangles"])
        title = {"views": "Hull of the views", "points": "Surface of the points"}
        yield _fewer(Shape("source", title.get(entry["kind"], "Input as taken"), "classify", mesh))


def _same(folder: RunFolder, entry: dict[str, Any]) -> Path:
    """The input's file. Raises InputError unless it is unchanged since the run."""
    path: Path = folder.path / entry["path"]
    if not path.exists():
        raise InputError(f"{path.name} is not where it was")
    if identify_path(entry["kind"], path).sha256 != entry["sha256"]:
        raise InputError(f"{path.name} has changed since")
    return path


def _mesh(path: Path) -> Shape:
    from ..formats.mesh_file import load

    return _fewer(Shape("input", "Input", "input", load(path).polygons, colour=INPUT))


def _cloud(path: Path, columns: str | None) -> Shape:
    from ..formats.cloud_file import load

    points = load(path, columns).points
    shown = thinned(points, POINTS)
    note = (
        "" if len(shown) == len(points) else f"{len(shown):,} of {len(points):,} points are drawn."
    )
    # Darker than faces, so that single dots are visible on a light page and on a dark one.
    return Shape("input", "Input points", "input", None, shown, INPUT * 0.7, note=note)


def _fewer(shape: Shape) -> Shape:
    """``shape`` with at most as many triangles as a page can draw."""
    from ..mesh.geometry import fan_triangles

    mesh = shape.mesh
    assert mesh is not None
    if len(mesh.face_vertices) - 2 * mesh.face_count > TRIANGLES:
        vertices, triangles, _ = fan_triangles(mesh)
        vertices, triangles, _ = clustered(vertices, triangles)
        shape.note = f"Drawn coarser: {len(triangles):,} triangles for {mesh.face_count:,} faces."
        shape.mesh, shape.edges = PolygonMesh.of_triangles(vertices, triangles), False
    return shape


def _voxels(grid: Arrays) -> Iterator[Shape]:
    mesh = voxel_surface(grid["interior"])
    if 2 * mesh.face_count > TRIANGLES:
        return
    # Voxel (0, 0, 0) has its lower corner at the origin.
    placed = mesh.with_vertices(grid["origin"] + grid["spacing"] * mesh.vertices)
    yield Shape("voxels", "Interior voxels", "classify", placed)


def _stages(folder: RunFolder) -> Iterator[Shape]:
    """The surfaces that the stages wrote."""
    if folder.manifest("init") is not None:
        arrays = folder.arrays("init", "init")
        yield Shape("init", "Initial surface", "init", PolygonMesh.from_arrays(arrays, "surface/"))
    if folder.manifest("sphere-train") is not None:
        arrays = folder.arrays("sphere-train", "sphere-train")
        trained = PolygonMesh.from_arrays(arrays, "trained/")
        yield Shape("trained", "Trained polygons", "sphere-train", trained)
        written = PolygonMesh.from_arrays(arrays, "surface/")
        yield Shape("sphere-train", "Surface as written", "sphere-train", written)
    if folder.manifest("volume") is not None:
        arrays = folder.arrays("volume", "volume")
        mesh = PolygonMesh.from_arrays(arrays)
        outer = mesh.select_faces(arrays["face_neighbour"] < 0).without_unused_vertices()
        yield Shape("volume", "Volume, outside", "volume", outer)
        half, _, _, inner = cut_open(folder)
        half = half.without_unused_vertices()
        yield Shape("cut", "Volume, cut open", "volume", half, tint=inner)
    if folder.manifest("baseline") is not None:
        mesh = PolygonMesh.from_arrays(folder.arrays("baseline", "baseline"), "surface/")
        yield _fewer(Shape("baseline", "Baseline", "baseline", mesh))


def _object(folder: RunFolder) -> Iterator[Shape]:
    """The object of stage fabricate, in the coordinates of the input."""
    if folder.manifest("fabricate") is None:
        return
    vertices, triangles = printed(folder)
    count, note = len(triangles), ""
    if count > TRIANGLES:
        tolerance = 2e-4 * float(np.ptp(vertices, axis=0).max())
        vertices, triangles, moved = simplified(vertices, triangles, tolerance)
        note = (
            f"Drawn with {len(triangles):,} of its {count:,} triangles, "
            f"to within about {moved:.2g} mm."
        )
    matrix = np.linalg.inv(folder.arrays("fabricate", "fabricate")["mm_from_input"])
    placed = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    mesh = PolygonMesh.of_triangles(placed, triangles)
    shape = Shape("fabricate", "Object to print", "fabricate", mesh, colour=PRINT, edges=False)
    shape.note = note
    yield shape


def _colourings(folder: RunFolder, shape: Shape, spacing: float | None) -> None:
    """Add the values that can colour the surface, and the reasons why others cannot."""
    mesh = shape.mesh
    assert mesh is not None
    if spacing is not None:
        shape.fields["size"] = Values("face", face_frames(mesh)[0] / spacing**2)
    _measured(folder, shape)
    if shape.stage == "sphere-train" and spacing is not None:
        arrays = folder.arrays("sphere-train", "sphere-train")
        trained = residuals(arrays, spacing)
        if shape.key == "sphere-train":
            # A face between two pairs belongs to both of their trained faces.
            trained = np.sqrt((trained[arrays["surface/face_generators"]] ** 2).mean(axis=1))
        shape.fields["residual"] = Values("face", trained)
    else:
        shape.missing["residual"] = "Only the surfaces of sphere-train have spheres."


def _measured(folder: RunFolder, shape: Shape) -> None:
    """Distance and curvature from the evaluation of this surface, if there is one."""
    stem = f"evaluate-{shape.stage}"
    if shape.key in ("trained", "cut"):
        other = {"trained": "the surface as written", "cut": "the outside of the volume"}[shape.key]
        for mode in ("error", "curvature"):
            shape.missing[mode] = f"{MODES[mode][0]} is measured on {other}."
        return
    stored = folder.manifest(stem)
    if stored is None:
        for mode in ("error", "curvature"):
            shape.missing[mode] = (
                f"{MODES[mode][0]} was not measured here; "
                f"run: vorolight evaluate --of {shape.stage}"
            )
        return
    arrays = folder.arrays(stem, "evaluate")
    measured = PolygonMesh.from_arrays(arrays, "surface/")
    assert shape.mesh is not None
    if not np.array_equal(measured.vertices, shape.mesh.vertices):
        for mode in ("error", "curvature"):
            shape.missing[mode] = (
                f"{MODES[mode][0]} was measured on an earlier surface; "
                f"run: vorolight evaluate --of {shape.stage}"
            )
        return
    diagonal = float(stored["metrics"]["protocol"]["diagonal"])
    shape.fields["error"] = Values("vertex", arrays["vertex_distance"] / diagonal)
    shape.fields["curvature"] = Values("vertex", np.abs(arrays["mean_curvature"]))


def residuals(arrays: Arrays, spacing: float) -> Floats:
    """Per trained face, ``(F,)``: root mean square, over its spheres and its two generators, of the
    power ``|g - c|^2 - r^2``, in units of ``spacing^2``; 0 where both lie on all of them."""
    mesh = PolygonMesh.from_arrays(arrays, "trained/")
    corner, face = mesh.face_vertices, mesh.corner_faces
    centre, square = arrays["spheres/center"][corner], arrays["spheres/radius"][corner] ** 2
    powers = [
        ((arrays[f"generators/{side}"][face] - centre) ** 2).sum(axis=1) - square
        for side in ("inside", "outside")
    ]
    total = face_sums(mesh, powers[0] ** 2 + powers[1] ** 2)
    return np.asarray(np.sqrt(total / np.maximum(2 * mesh.valences, 1)) / spacing**2, np.float64)
