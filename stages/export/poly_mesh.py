"""OpenFOAM's polyMesh: points, faces, owner, neighbour and boundary, as text."""

from __future__ import annotations

from itertools import pairwise

from ..surface.polygons import Floats, Ints
from ..voronoi.cells import PolyhedralMesh

PATCH = "surface"

SYSTEM = {
    "controlDict": """application     checkMesh;
startFrom       startTime;
startTime       0;
stopAt          endTime;
endTime         1;
deltaT          1;
writeControl    timeStep;
writeInterval   1;
""",
    "fvSchemes": """ddtSchemes { default steadyState; }
gradSchemes { default Gauss linear; }
divSchemes { default none; }
laplacianSchemes { default Gauss linear corrected; }
interpolationSchemes { default linear; }
snGradSchemes { default corrected; }
""",
    "fvSolution": "solvers { }\n",
}
"""Without these no OpenFOAM program starts, checkMesh included; to be replaced by the user's."""


def _header(kind: str, name: str, place: str, note: str = "") -> str:
    # The note must be there in owner files: readers take the numbers of cells and faces from it.
    lines = ["version 2.0;", "format ascii;", f"class {kind};"]
    if note:
        lines.append(f'note "{note}";')
    lines += [f'location "{place}";', f"object {name};"]
    return "FoamFile\n{\n" + "".join(f"    {line}\n" for line in lines) + "}\n\n"


def _labels(values: Ints) -> str:
    return f"{len(values)}\n(\n" + "\n".join(map(str, values.tolist())) + "\n)\n"


def _points(vertices: Floats) -> str:
    rows = "\n".join(f"({x!r} {y!r} {z!r})" for x, y, z in vertices.tolist())
    return f"{len(vertices)}\n(\n{rows}\n)\n"


def _faces(offsets: Ints, corners: Ints) -> str:
    words = list(map(str, corners.tolist()))
    ends = offsets.tolist()
    rows = "\n".join(
        f"{end - start}({' '.join(words[start:end])})" for start, end in pairwise(ends)
    )
    return f"{len(ends) - 1}\n(\n{rows}\n)\n"


def encode(mesh: PolyhedralMesh) -> dict[str, bytes]:
    """Files of a case by path, ``constant/polyMesh/*`` and ``system/*``. Coordinates keep all their
    digits; there is one patch, ``surface``."""
    inner = int((mesh.neighbour >= 0).sum())
    faces, place = mesh.faces, "constant/polyMesh"
    note = (
        f"nPoints:{faces.vertex_count}  nCells:{mesh.cell_count}  "
        f"nFaces:{faces.face_count}  nInternalFaces:{inner}"
    )
    patch = (
        f"1\n(\n    {PATCH}\n    {{\n        type patch;\n"
        f"        nFaces {faces.face_count - inner};\n        startFace {inner};\n    }}\n)\n"
    )
    texts = {
        f"{place}/points": _header("vectorField", "points", place) + _points(faces.vertices),
        f"{place}/faces": _header("faceList", "faces", place)
        + _faces(faces.face_offsets, faces.face_vertices),
        f"{place}/owner": _header("labelList", "owner", place, note) + _labels(mesh.owner),
        f"{place}/neighbour": _header("labelList", "neighbour", place, note)
        + _labels(mesh.neighbour[:inner]),
        f"{place}/boundary": _header("polyBoundaryMesh", "boundary", place) + patch,
        **{
            f"system/{name}": _header("dictionary", name, "system") + text
            for name, text in SYSTEM.items()
        },
    }
    return {path: text.encode("ascii") for path, text in texts.items()}
