"""PLY: writes polygon surfaces, binary or as text; reads PLY files with vertices and faces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..mesh.polygons import Floats, Ints, PolygonMesh

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def encode(
    mesh: PolygonMesh,
    vertex_data: Mapping[str, Floats] | None = None,
    face_data: Mapping[str, Floats] | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> bytes:
    """``mesh`` as a PLY file with double coordinates and int32 indices.

    There may be scalars for vertices and faces, and ``colours (V, 3)`` in red, green and blue.
    Faces with one number of corners are written as little-endian binary. Otherwise the file is
    text, with all digits, because trimesh and some other readers take the size of all binary lists
    from the first one. Raises InputError if a face has more than 255 corners.
    """
    vertex_data, face_data = dict(vertex_data or {}), dict(face_data or {})
    even = mesh.face_count == 0 or bool((mesh.valences == mesh.valences[0]).all())
    kind = "binary_little_endian" if even else "ascii"
    header = ["ply", f"format {kind} 1.0", "comment vorolight"]
    header += [f"element vertex {mesh.vertex_count}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property float {name}" for name in vertex_data]
    if colours is not None:
        header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {mesh.face_count}", "property list uchar int vertex_indices"]
    header += [f"property float {name}" for name in face_data]
    if mesh.face_count and mesh.valences.max() > 255:
        raise InputError("a face has more than 255 corners, which a PLY list cannot hold")
    fields = [("xyz", "<f8", (3,)), *((name, "<f4") for name in vertex_data)]
    if colours is not None:
        fields.append(("rgb", "u1", (3,)))
    vertices = np.zeros(mesh.vertex_count, dtype=fields)
    vertices["xyz"] = mesh.vertices
    for name, values in vertex_data.items():
        vertices[name] = values
    if colours is not None:
        vertices["rgb"] = colours
    text = ("\n".join([*header, "end_header"]) + "\n").encode("ascii")
    if not even:
        return text + _as_text(mesh, vertex_data, face_data, colours)
    extra = 4 * len(face_data)
    rows = 1 + 4 * mesh.valences + extra
    starts = np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)
    body = np.zeros(starts[-1], dtype=np.uint8)
    body[starts[:-1]] = mesh.valences
    within = np.arange(len(mesh.face_vertices)) - mesh.face_offsets[:-1][mesh.corner_faces]
    at = starts[:-1][mesh.corner_faces] + 1 + 4 * within
    corner_bytes = mesh.face_vertices.astype("<i4").view(np.uint8).reshape(-1, 4)
    body[at[:, None] + np.arange(4)] = corner_bytes
    for number, values in enumerate(face_data.values()):
        at = starts[1:] - extra + 4 * number
        body[at[:, None] + np.arange(4)] = (
            np.ascontiguousarray(values, dtype="<f4").view(np.uint8).reshape(-1, 4)
        )
    return text + vertices.tobytes() + body.tobytes()


def _as_text(
    mesh: PolygonMesh,
    vertex_data: Mapping[str, Floats],
    face_data: Mapping[str, Floats],
    colours: NDArray[np.uint8] | None,
) -> bytes:
    """The lines of vertices and faces. All numbers have so many digits that they
    are read back exactly."""
    columns = [mesh.vertices[:, axis].tolist() for axis in range(3)]
    columns += [np.asarray(values, np.float32).tolist() for values in vertex_data.values()]
    columns += [] if colours is None else [colours[:, k].tolist() for k in range(3)]
    lines = [" ".join(map(repr, row)) for row in zip(*columns, strict=True)]
    corners = list(map(str, mesh.face_vertices.tolist()))
    ends = mesh.face_offsets.tolist()
    scalars = [np.asarray(values, np.float32).tolist() for values in face_data.values()]
    rows = zip(*scalars, strict=True) if scalars else ((),) * mesh.face_count
    lines += [
        " ".join([str(end - start), *corners[start:end], *map(repr, row)])
        for start, end, row in zip(ends[:-1], ends[1:], rows, strict=True)
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _row_starts(first: int, following: Ints, count: int) -> Ints:
    """The starts of ``count`` rows, of which row i starts at ``following[start of row i - 1]``.

    Pointer doubling avoids a loop over rows, although each start depends on the one before.
    """
    starts = np.array([first], dtype=np.int64)
    jump = following
    while len(starts) < count:
        starts = np.concatenate([starts, jump[starts]])
        if len(starts) < count:
            jump = jump[jump]
    return starts[:count]


def _ragged_faces(values: Ints, counts_at: Ints, width: int, count: int) -> tuple[Ints, Ints]:
    """Offsets of ``count`` lists that follow each other, and the positions
    of their first entries."""
    length = len(values)
    following = np.minimum(np.arange(length) + 1 + width * counts_at, length - 1)
    starts = _row_starts(0, following, count)
    sizes = counts_at[starts]
    if count and starts[-1] + 1 + width * sizes[-1] > length:
        raise ValueError("the face list ends early")
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    owner = np.repeat(np.arange(count), sizes)
    within = np.arange(offsets[-1]) - offsets[:-1][owner]
    return offsets, starts[owner] + 1 + width * within


Element = tuple[str, int, list[list[str]]]
"""The name, the count, and the words of each property of an element."""


def _header(raw: bytes) -> tuple[str, list[Element], int]:
    end = raw.find(b"end_header")
    if not raw.startswith(b"ply") or end < 0:
        raise ValueError("it has no PLY header")
    body = raw.find(b"\n", end) + 1
    kind = ""
    elements: list[Element] = []
    for line in raw[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "format" and len(words) > 1:
            kind = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements:
            elements[-1][2].append(words[1:])
    return kind, elements, body


def _columns(
    raw: bytes, kind: str, element: Element, at: int, wanted: tuple[str, ...]
) -> Floats | None:
    """The properties ``wanted`` of the first element ``(N, len(wanted))``, or
    None if it lacks some."""
    _, count, properties = element
    names = [p[1] for p in properties]
    if not set(wanted) <= set(names):
        return None
    if kind == "ascii":
        words = raw[at:].split(maxsplit=count * len(names))[: count * len(names)]
        table = np.array(words, dtype=np.float64).reshape(count, len(names))
        return np.stack([table[:, names.index(name)] for name in wanted], axis=1)
    layout = np.dtype([(p[1], _ORDERS[kind] + _TYPES[p[0]]) for p in properties])
    records = np.frombuffer(raw, layout, count, at)
    return np.stack([records[name].astype(np.float64) for name in wanted], axis=1)


def decode(raw: bytes) -> PolygonMesh | None:
    """The polygons of a PLY. None if it has more than vertices and one list of corners for each
    face.

    Raises ValueError if the file is damaged.
    """
    kind, elements, at = _header(raw)
    if [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        return None
    (_, vertex_count, vertex_properties), (_, face_count, face_properties) = elements[:2]
    if any(p[0] == "list" for p in vertex_properties) or len(face_properties) != 1:
        return None
    corner_list = face_properties[0]
    if len(corner_list) != 4 or corner_list[0] != "list":
        return None
    if vertex_count < 0 or face_count < 0 or vertex_count + face_count > len(raw):
        raise ValueError("its header promises more elements than the file has bytes")
    vertices = _columns(raw, kind, elements[0], at, ("x", "y", "z"))
    if vertices is None:
        raise ValueError("its vertices have no x, y, z")
    if kind == "ascii":
        numbers = np.array(raw[at:].split(), dtype=np.float64)
        tokens = numbers[vertex_count * len(vertex_properties) :].astype(np.int64)
        if face_count and len(tokens) == 0:
            raise ValueError("the face list ends early")
        offsets, positions = _ragged_faces(tokens, tokens, 1, face_count)
        return PolygonMesh(vertices, offsets, tokens[positions])
    order = _ORDERS[kind]
    size = sum(np.dtype(_TYPES[p[0]]).itemsize for p in vertex_properties)
    body = np.frombuffer(raw, np.uint8, offset=at + vertex_count * size)
    if _TYPES[corner_list[1]] not in ("u1", "i1") or np.dtype(_TYPES[corner_list[2]]).itemsize != 4:
        return None
    if face_count and len(body) == 0:
        raise ValueError("the face list ends early")
    offsets, positions = _ragged_faces(body.astype(np.int64), body.astype(np.int64), 4, face_count)
    index_bytes = np.ascontiguousarray(body[positions[:, None] + np.arange(4)])
    indices = index_bytes.view(order + _TYPES[corner_list[2]]).reshape(-1).astype(np.int64)
    return PolygonMesh(vertices, offsets, indices)


def decode_points(raw: bytes) -> tuple[Floats, Floats | None]:
    """The vertices ``(N, 3)`` of a PLY, and their normals if there are any.

    Raises ValueError if the file is damaged, and KeyError if a property has an unknown type.
    """
    kind, elements, at = _header(raw)
    if not elements or elements[0][0] != "vertex":
        raise ValueError("its first element is not the vertices")
    if elements[0][1] < 0 or elements[0][1] > len(raw):
        raise ValueError("its header promises more elements than the file has bytes")
    points = _columns(raw, kind, elements[0], at, ("x", "y", "z"))
    if points is None:
        raise ValueError("its vertices have no x, y, z")
    return points, _columns(raw, kind, elements[0], at, ("nx", "ny", "nz"))


def may_have_faces(start: bytes) -> bool:
    """Whether the header at the ``start`` of a PLY announces faces or strips, or cannot be read."""
    try:
        return any(name != "vertex" and count for name, count, _ in _header(start)[1])
    except ValueError:
        return True


def read(path: Path) -> PolygonMesh | None:
    """The same as ``decode``, for a file."""
    return decode(Path(path).read_bytes())
