"""VTU: polyhedral cells for ParaView and other VTK readers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..surface.polygons import Floats, Ints
from ..voronoi.cells import PolyhedralMesh

POLYHEDRON = 42


def _streams(mesh: PolyhedralMesh) -> tuple[Ints, Ints, Ints, Ints]:
    """VTK's ``faces`` stream and its offsets, ``connectivity`` and its offsets."""
    valence = mesh.faces.valences
    count = len(mesh.cell_generator)
    faces = np.arange(len(valence))
    inner = mesh.neighbour >= 0
    half_face = np.concatenate([faces, faces[inner]])
    half_cell = np.concatenate([mesh.owner, mesh.neighbour[inner]])
    reverse = np.concatenate([np.zeros(len(faces), bool), np.ones(int(inner.sum()), bool)])
    order = np.argsort(half_cell, kind="stable")
    half_face, half_cell, reverse = half_face[order], half_cell[order], reverse[order]
    size = valence[half_face]
    per_cell = np.bincount(half_cell, minlength=count)
    cell_length = 1 + np.bincount(half_cell, size + 1, minlength=count).astype(np.int64)
    face_offsets = np.cumsum(cell_length)
    stream = np.zeros(face_offsets[-1], dtype=np.int64)
    starts = face_offsets - cell_length
    stream[starts] = per_cell
    before = np.cumsum(size + 1) - (size + 1)
    at = before + half_cell + 1  # one count per cell up to and with this one
    stream[at] = size
    row = np.repeat(np.arange(len(half_face)), size)
    within = np.arange(len(row)) - np.repeat(np.cumsum(size) - size, size)
    take = np.where(reverse[row], size[row] - 1 - within, within)
    corner = mesh.faces.face_vertices[mesh.faces.face_offsets[half_face[row]] + take]
    stream[at[row] + 1 + within] = corner
    own = np.unique(half_cell[row] * mesh.faces.vertex_count + corner)
    owner, connectivity = np.divmod(own, mesh.faces.vertex_count)
    offsets = np.cumsum(np.bincount(owner, minlength=count))
    return stream, face_offsets, connectivity, offsets


def encode(mesh: PolyhedralMesh, cell_data: Mapping[str, Floats | Ints]) -> bytes:
    """The VTU bytes of ``mesh``; ``cell_data`` maps names to arrays ``(C,)``."""
    stream, face_offsets, connectivity, offsets = _streams(mesh)
    count = len(mesh.cell_generator)
    blocks: list[bytes] = []
    position = 0

    def array(name: str, values: np.ndarray[Any, Any], components: int = 1) -> str:
        nonlocal position
        kind = {"f8": "Float64", "i8": "Int64", "u1": "UInt8"}[values.dtype.str[1:]]
        data = np.ascontiguousarray(values).tobytes()
        line = (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" '
            f'format="appended" offset="{position}"/>\n'
        )
        blocks.append(np.uint64(len(data)).tobytes() + data)
        position += 8 + len(data)
        return line

    text = (
        '<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="1.0" '
        'byte_order="LittleEndian" header_type="UInt64">\n<UnstructuredGrid>\n'
        f'<Piece NumberOfPoints="{mesh.faces.vertex_count}" NumberOfCells="{count}">\n<Points>\n'
    )
    text += array("Points", mesh.faces.vertices.astype("<f8"), 3)
    text += "</Points>\n<Cells>\n"
    text += array("connectivity", connectivity.astype("<i8"))
    text += array("offsets", offsets.astype("<i8"))
    text += array("types", np.full(count, POLYHEDRON, dtype="u1"))
    text += array("faces", stream.astype("<i8"))
    text += array("faceoffsets", face_offsets.astype("<i8"))
    text += "</Cells>\n<CellData>\n"
    for name, values in cell_data.items():
        kind = "<f8" if np.asarray(values).dtype.kind == "f" else "<i8"
        text += array(name, np.asarray(values).astype(kind))
    text += "</CellData>\n</Piece>\n</UnstructuredGrid>\n"
    text += '<AppendedData encoding="raw">\n_'
    return text.encode("ascii") + b"".join(blocks) + b"\n</AppendedData>\n</VTKFile>\n"
