"""Meshes for the benchmarks: samples of installed packages, and generated ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from vorolight.stages.formats import ply
from vorolight.stages.inputs.field.source import FieldSource
from vorolight.stages.inputs.samples import sample
from vorolight.stages.mesh.geometry import limited
from vorolight.stages.mesh.polygons import PolygonMesh

Surface = tuple[np.ndarray, np.ndarray]
SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
ACROSS = 96
"""Number of grid cells along the longest side of a field."""


def of_field(name: str) -> Surface:
    """The zero set of a built-in field by marching cubes, with its vertices moved onto it."""
    import igl

    source = FieldSource(name)
    low, high = source.bounding_box()
    edge = float((high - low).max()) / ACROSS
    counts = np.ceil((high - low) / edge).astype(int) + 3
    axes = [low[k] - edge + edge * np.arange(counts[k]) for k in range(3)]
    # The index of igl's grids runs fastest along x.
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    vertices, triangles = igl.marching_cubes(source.value(points), points, *map(int, counts))[:2]
    for _ in range(3):
        value, slope = source.gradient(vertices)
        steep = np.maximum((slope**2).sum(axis=1), 1e-12)
        vertices = vertices - limited((value / steep)[:, None] * slope, 0.3 * edge)
    return oriented(vertices, triangles)


def knot() -> Surface:
    """A tube of radius 0.32 around a trefoil knot."""
    around, along = 24, 240
    t = np.linspace(0, 2 * np.pi, along, endpoint=False)
    axis = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)])
    return tube(axis.T, 0.32, around)


def spring() -> Surface:
    """A closed tube of radius 0.16 that winds five times around a ring."""
    t = np.linspace(0, 2 * np.pi, 480, endpoint=False)
    ring = 1.5 + 0.5 * np.cos(5 * t)
    return tube(
        np.column_stack([ring * np.cos(t), ring * np.sin(t), 0.5 * np.sin(5 * t)]), 0.16, 20
    )


def tube(axis: np.ndarray, radius: float, around: int) -> Surface:
    """Triangles of a tube around the closed polyline ``axis (N, 3)``."""
    along = len(axis)
    tangent = np.roll(axis, -1, axis=0) - np.roll(axis, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # A vector is carried along the axis. Its rotation after one round is spread over all of it.
    normal = np.zeros_like(axis)
    carried = np.cross(tangent[0], [0.0, 0.0, 1.0])
    for k in [*range(along), 0]:
        carried = carried - (carried @ tangent[k]) * tangent[k]
        carried /= np.linalg.norm(carried)
        if k or not normal[0].any():
            normal[k] = carried
    other = np.cross(tangent, normal)
    turn = -np.arctan2(carried @ other[0], carried @ normal[0]) * np.arange(along) / along
    angle = turn[:, None] + 2 * np.pi * np.arange(around) / around
    rim = np.cos(angle)[..., None] * normal[:, None] + np.sin(angle)[..., None] * other[:, None]
    vertices = (axis[:, None] + radius * rim).reshape(-1, 3)
    k, j = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    a, b = k * around + j, k * around + (j + 1) % around
    c, d = (k + 1) % along * around + j, (k + 1) % along * around + (j + 1) % around
    triangles = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)
    return oriented(vertices, triangles)


def bumpy() -> Surface:
    """A sphere with bumps."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5)
    x, y, z = np.asarray(ball.vertices).T
    height = 1 + 0.18 * np.sin(3 * np.arctan2(y, x)) * (1 - z * z) ** 1.5 + 0.1 * np.cos(5 * z)
    return oriented(height[:, None] * np.asarray(ball.vertices), np.asarray(ball.faces))


def oriented(vertices: np.ndarray, triangles: np.ndarray) -> Surface:
    """The surface with its normals outward."""
    triangles = np.asarray(triangles, np.int64)
    volume = np.linalg.det(vertices[triangles] - vertices.mean(axis=0)).sum()
    return vertices, triangles if volume > 0 else triangles[:, ::-1]


GENERATED: dict[str, Callable[[], Surface]] = {
    "heart": lambda: of_field("heart"),
    "torus": lambda: of_field("torus"),
    "genus-two": lambda: of_field("genus-two"),
    "gyroid": lambda: of_field("gyroid"),
    "knot": knot,
    "spring": spring,
    "bumpy": bumpy,
}
SAMPLED = ("bunny", "cow", "airplane")


def default(folder: Path, names: list[str] | None = None) -> list[Path]:
    """The sample meshes and the generated shapes as files in ``folder``, or
    only those of ``names``."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name in names or [*SAMPLED, *GENERATED]:
        path = folder / f"{name}.ply"
        if name in SAMPLED:
            path = sample(name)
        elif not path.is_file():
            mesh = PolygonMesh.of_triangles(*GENERATED[name]())
            path.write_bytes(ply.encode(mesh))
        found.append(path)
    return found


def of_folder(folder: Path) -> list[Path]:
    """The meshes in a folder."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not found:
        raise SystemExit(f"{folder}: holds no mesh ({', '.join(SUFFIXES)})")
    return found
