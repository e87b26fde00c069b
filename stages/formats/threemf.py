"""3MF, read and written with lib3mf: bodies in millimetres, with a title.

The same content always gives the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import uuid
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.polygons import Floats, Ints, PolygonMesh

EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest date that a ZIP archive can hold. It replaces the present date."""
MILLIMETRES = (0.001, 1.0, 10.0, 25.4, 304.8, 1000.0)
"""Length in mm of the units as lib3mf numbers them: micrometre, millimetre,
centimetre, inch, foot, metre."""
DEEPEST, MOST_BODIES = 16, 100_000
"""Largest depth of components within components, and largest number of meshes in a file."""


@dataclass(frozen=True)
class Body:
    """A body to print, with ``vertices (V, 3) float32`` in mm and ``triangles (T, 3)``."""

    name: str
    vertices: NDArray[np.float32]
    triangles: Ints


def encode(bodies: list[Body], title: str, application: str) -> bytes:
    """A 3MF file of ``bodies``.

    Raises NumericalFailure if lib3mf finds that one is not manifold and oriented.
    """
    import lib3mf

    wrapper = lib3mf.get_wrapper()
    model = wrapper.CreateModel()
    model.SetUnit(lib3mf.ModelUnit.MilliMeter)
    data = model.GetMetaDataGroup()
    data.AddMetaData("", "Title", title, "xs:string", True)
    data.AddMetaData("", "Application", application, "xs:string", True)
    digest = hashlib.sha256(f"{title}\n{application}".encode())
    for body in bodies:
        digest.update(body.vertices.tobytes() + body.triangles.tobytes())

    def identifier(role: str) -> str:
        # 3MF needs unique identifiers. Hashes of the content are the same each time.
        return str(uuid.UUID(bytes=hashlib.sha256(digest.digest() + role.encode()).digest()[:16]))

    model.SetBuildUUID(identifier("build"))
    for number, body in enumerate(bodies):
        item = model.AddMeshObject()
        item.SetName(body.name)
        item.SetGeometry(_positions(lib3mf, body.vertices), _triangles(lib3mf, body.triangles))
        if not item.IsManifoldAndOriented():
            raise NumericalFailure(f"lib3mf: {body.name} is not manifold and oriented")
        item.SetUUID(identifier(f"object {number}"))
        build = model.AddBuildItem(item, wrapper.GetIdentityTransform())
        build.SetUUID(identifier(f"item {number}"))
    writer = model.QueryWriter("3mf")
    writer.SetDecimalPrecision(9)
    return _undated(bytes(bytearray(writer.WriteToBuffer())))


def decode(raw: bytes) -> PolygonMesh:
    """The triangles of all objects that a 3MF file builds, at their places, in millimetres.

    Components are included. Raises ValueError if lib3mf cannot read the file.
    """
    import lib3mf

    vertices: list[Floats] = [np.zeros((0, 3))]
    triangles: list[Ints] = [np.zeros((0, 3), np.int64)]
    found = 0

    def add(item: Any, place: Floats, depth: int) -> None:
        nonlocal found
        if depth > DEEPEST or len(vertices) > MOST_BODIES:
            raise ValueError("its components contain each other, or are too many")
        if item.IsMeshObject():
            at = np.frombuffer(b"".join(item.GetVertices()), np.float32).reshape(-1, 3)
            corners = np.frombuffer(b"".join(item.GetTriangleIndices()), np.uint32).reshape(-1, 3)
            # Otherwise a mirrored component would be inside out.
            way = 1 if np.linalg.det(place[:3]) > 0 else -1
            vertices.append(at @ place[:3] + place[3])
            triangles.append(corners.astype(np.int64)[:, ::way] + found)
            found += len(at)
        elif item.IsComponentsObject():
            for number in range(item.GetComponentCount()):
                part = item.GetComponent(number)
                own = _placement(part.GetTransform())
                whole = np.concatenate([own[:3] @ place[:3], [own[3] @ place[:3] + place[3]]])
                add(part.GetObjectResource(), whole, depth + 1)

    try:
        model = lib3mf.get_wrapper().CreateModel()
        model.QueryReader("3mf").ReadFromBuffer(bytearray(raw))
        items = model.GetBuildItems()
        while items.MoveNext():
            item = items.GetCurrent()
            add(item.GetObjectResource(), _placement(item.GetObjectTransform()), 0)
        unit = MILLIMETRES[int(model.GetUnit())]
    except lib3mf.ELib3MFException as error:
        raise ValueError(str(error).splitlines()[0]) from error
    return PolygonMesh.of_triangles(unit * np.concatenate(vertices), np.concatenate(triangles))


def _placement(transform: Any) -> Floats:
    """The transform as ``(4, 3)``: three rows by which a point is
    multiplied, and the translation."""
    return np.array([list(row) for row in transform.Fields], dtype=np.float64)


def _positions(lib3mf: Any, vertices: NDArray[np.float32]) -> Any:
    array = (lib3mf.Position * len(vertices))()
    np.frombuffer(array, dtype=np.float32).reshape(-1, 3)[:] = vertices
    return array


def _triangles(lib3mf: Any, triangles: Ints) -> Any:
    array = (lib3mf.Triangle * len(triangles))()
    np.frombuffer(array, dtype=np.uint32).reshape(-1, 3)[:] = triangles
    return array


def _undated(data: bytes) -> bytes:
    """The archive with all dates replaced by EPOCH."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            fixed = zipfile.ZipInfo(entry.filename, EPOCH)
            fixed.compress_type = zipfile.ZIP_DEFLATED
            new.writestr(fixed, old.read(entry))
    return target.getvalue()


def read(data: bytes) -> list[Body]:
    """The bodies of a 3MF file at their places, read in lib3mf's strict mode.

    Raises ValueError if there are warnings.
    """
    import lib3mf

    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    try:
        reader.ReadFromBuffer(bytearray(data))
    except lib3mf.ELib3MFException as error:
        raise ValueError(str(error)) from error
    if reader.GetWarningCount():
        raise ValueError(str(reader.GetWarning(0)))
    bodies = []
    objects = model.GetMeshObjects()
    while objects.MoveNext():
        item = objects.GetCurrentMeshObject()
        bodies.append(
            Body(
                item.GetName(),
                _records(item.GetVertices(), np.float32),
                _records(item.GetTriangleIndices(), np.uint32).astype(np.int64),
            )
        )
    return bodies


def _records(found: Any, kind: Any) -> NDArray[Any]:
    """A list of lib3mf's structures of three numbers as an array ``(N, 3)``."""
    return np.frombuffer(b"".join(map(bytes, found)), dtype=kind).reshape(-1, 3)
