"""Reads meshes: OBJ, PLY and 3MF with their polygons, and all other formats with trimesh."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..mesh.polygons import Floats, PolygonMesh
from . import gltf, packed, ply, threemf
from .concave import without_concave


@dataclass(frozen=True)
class LoadedMesh:
    """A mesh as it is in a file: nothing is merged or repaired.

    Only faces that cannot become a fan about their middle are divided into triangles.
    """

    polygons: PolygonMesh
    polygons_kept: bool
    """False if trimesh read the file, because it divides polygons into triangles."""


def load(path: Path) -> LoadedMesh:
    """The mesh in ``path``, in the coordinates of the file.

    Raises InputError if the file is missing, empty or not a mesh, and if the mesh has no faces, has
    coordinates that are not finite, or is on a line.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a mesh file or the name of a built-in field")
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; export the mesh again")
        with np.errstate(all="ignore"):  # values that are not finite are found below
            mesh, kept = _read(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check it") from error
    if mesh.vertex_count == 0 or mesh.face_count == 0:
        raise InputError(
            f"{path}: has {mesh.vertex_count} vertices and {mesh.face_count} faces, so "
            "no surface; give a mesh with faces, or use it as a point cloud with "
            "--kind points"
        )
    if mesh.face_vertices.min() < 0 or mesh.face_vertices.max() >= mesh.vertex_count:
        raise InputError(
            f"{path}: a face refers to a vertex that does not exist; export the mesh again"
        )
    mesh = mesh.without_unused_vertices()
    bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{path}: {bad} vertices have coordinates that are not finite; repair the mesh"
        )
    if np.count_nonzero(np.ptp(mesh.vertices, axis=0)) < 2:
        raise InputError(f"{path}: all of the mesh lies on a line; export it again")
    return LoadedMesh(without_concave(mesh), kept)


def vertices_of(path: Path) -> Floats:
    """The vertices ``(V, 3)`` in ``path``, with or without faces. Raises InputError."""
    return _read(path)[0].vertices


def _read(path: Path) -> tuple[PolygonMesh, bool]:
    suffix = packed.ending(path)
    try:
        if suffix == ".obj":
            return _obj(packed.content(path)), True
        if suffix == ".ply":
            mesh = ply.decode(packed.content(path))
            if mesh is not None:
                return mesh, True
        if suffix == ".3mf":
            return threemf.decode(packed.content(path)), True
        if suffix in gltf.ENDINGS:
            refusal = gltf.refusal(packed.content(path))
            if refusal:
                raise InputError(f"{path}: {refusal}")
    except (ValueError, KeyError, IndexError, OverflowError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a readable {suffix[1:].upper()} file ({error})") from error
    return _read_trimesh(path), False


def _obj(raw: bytes) -> PolygonMesh:
    """Vertices and faces of a Wavefront OBJ. Negative indices count backwards from
    the last vertex so far."""
    vertices: list[bytes] = []
    corners: list[int] = []
    offsets = [0]
    content = raw.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    for number, line in enumerate(content.splitlines(), start=1):
        words = line.partition(b"#")[0].split()
        if not words:
            continue
        if words[0] == b"v":
            vertices.append(b" ".join(words[1:4]))
        elif words[0] == b"f":
            try:
                ring = [int(word.split(b"/", 1)[0]) for word in words[1:]]
            except ValueError:
                raise ValueError(f"line {number} is not a face") from None
            if 0 in ring:
                raise ValueError(f"line {number} refers to vertex 0, but OBJ counts from 1")
            if len(ring) > 2:
                corners.extend(index - 1 if index > 0 else len(vertices) + index for index in ring)
                offsets.append(len(corners))
    flat = np.array(b" ".join(vertices).split(), dtype=np.float64)
    if len(flat) != 3 * len(vertices):
        raise ValueError("a vertex has fewer than three coordinates")
    return PolygonMesh(
        flat.reshape(-1, 3), np.array(offsets, dtype=np.int64), np.array(corners, dtype=np.int64)
    )


def _read_trimesh(path: Path) -> PolygonMesh:
    import trimesh

    known = trimesh.available_formats()
    suffix = packed.ending(path)
    if suffix.lstrip(".") not in known:
        if packed.is_packed(path) and not suffix:
            raise InputError(
                f"{path}: its name does not say what is packed in it; call it ball.ply.gz if that "
                "is a PLY"
            )
        if suffix in (".tar", ".tgz", ".zip", ".xz", ".bz2", ".zst", ".7z"):
            raise InputError(f"{path}: is compressed; unpack it, and give the file inside")
        raise InputError(
            f"{path}: files of kind '{suffix}' cannot be read; convert a mesh to OBJ, PLY, STL or "
            "3MF, points to PLY, LAS or CSV, samples on a grid to NRRD, NIfTI, VTI or NPY"
        )
    try:
        if suffix in gltf.ENDINGS or packed.is_packed(path):
            file, kind = io.BytesIO(packed.content(path)), suffix.lstrip(".")
            scene = trimesh.load_scene(
                file, file_type=kind, resolver=gltf.resolver(path), process=False
            )
        else:
            scene = trimesh.load_scene(path, process=False)
        mesh = scene.to_mesh()
    except InputError:
        raise
    # On damaged files, the loaders of trimesh raise exceptions of any kind.
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: trimesh cannot read it ({reason[:120]})") from error
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return PolygonMesh.of_triangles(np.asarray(mesh.vertices, dtype=np.float64), faces)
