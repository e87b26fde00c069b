"""VTU: polyhedral cells or tetrahedra, for ParaView and other programs that use VTK."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..mesh.polygons import Floats, Ints
from ..mesh.polyhedra import PolyhedralMesh

TETRAHEDRON, POLYHEDRON = 10, 42


def _streams(mesh: PolyhedralMesh) -> tuple[Ints, Ints, Ints, Ints]:
    """VTK's ``faces`` and their offsets, and ``connectivity`` and its offsets."""
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
    at = before + half_cell + 1  # there is one count for each cell up to this one
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
    """``mesh`` as a VTU file. ``cell_data`` maps names to arrays ``(C,)``."""
    stream, face_offsets, connectivity, offsets = _streams(mesh)
    cells = {
        "connectivity": connectivity,
        "offsets": offsets,
        "types": np.full(mesh.cell_count, POLYHEDRON, dtype="u1"),
        "faces": stream,
        "faceoffsets": face_offsets,
    }
    return _encode(mesh.faces.vertices, cells, cell_data)


def encode_tetrahedra(
    vertices: Floats, tetrahedra: Ints, cell_data: Mapping[str, Floats | Ints]
) -> bytes:
    """``tetrahedra (T, 4)`` as a VTU file. ``cell_data`` maps names to arrays ``(T,)``."""
    count = len(tetrahedra)
    cells = {
        "connectivity": tetrahedra.reshape(-1),
        "offsets": 4 * np.arange(1, count + 1),
        "types": np.full(count, TETRAHEDRON, dtype="u1"),
    }
    return _encode(vertices, cells, cell_data)


def _encode(
    vertices: Floats, cells: Mapping[str, Any], cell_data: Mapping[str, Floats | Ints]
) -> bytes:
    blocks: list[bytes] = []
    position = 0

    def array(name: str, values: Any, components: int = 1) -> str:
        nonlocal position
        numbers = {"f": ("<f8", "Float64"), "i": ("<i8", "Int64"), "u": ("u1", "UInt8")}
        kind, called = numbers[values.dtype.kind]
        data = np.ascontiguousarray(values, dtype=kind).tobytes()
        line = (
            f'<DataArray type="{called}" Name="{name}" NumberOfComponents="{components}" '
            f'format="appended" offset="{position}"/>\n'
        )
        blocks.append(np.uint64(len(data)).tobytes() + data)
        position += 8 + len(data)
        return line

    text = (
        '<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="1.0" '
        'byte_order="LittleEndian" header_type="UInt64">\n<UnstructuredGrid>\n'
        f'<Piece NumberOfPoints="{len(vertices)}" NumberOfCells="{len(cells["offsets"])}">\n'
        "<Points>\n"
    )
    text += array("Points", vertices, 3)
    text += "</Points>\n<Cells>\n"
    text += "".join(array(name, values) for name, values in cells.items())
    text += "</Cells>\n<CellData>\n"
    text += "".join(array(name, np.asarray(values)) for name, values in cell_data.items())
    text += "</CellData>\n</Piece>\n</UnstructuredGrid>\n"
    text += '<AppendedData encoding="raw">\n_'
    return text.encode("ascii") + b"".join(blocks) + b"\n</AppendedData>\n</VTKFile>\n"
