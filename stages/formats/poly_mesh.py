"""polyMesh of OpenFOAM: points, faces, owner, neighbour and boundary, as text."""

from __future__ import annotations

from ..mesh.polyhedra import PolyhedralMesh
from .text import lists, rows

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
"""Settings that every OpenFOAM program needs in order to start. A user replaces them."""


def _header(kind: str, name: str, place: str, note: str = "") -> str:
    # Readers take the numbers of cells and faces from the note, which owner files must have.
    lines = ["version 2.0;", "format ascii;", f"class {kind};"]
    if note:
        lines.append(f'note "{note}";')
    lines += [f'location "{place}";', f"object {name};"]
    return "FoamFile\n{\n" + "".join(f"    {line}\n" for line in lines) + "}\n\n"


def _list(count: int, lines: str) -> str:
    return f"{count}\n(\n{lines}\n)\n"


def encode(mesh: PolyhedralMesh) -> dict[str, bytes]:
    """The files of a case by path, in ``constant/polyMesh`` and ``system``.

    Coordinates have all their digits. There is one patch, ``surface``.
    """
    inner = int((mesh.neighbour >= 0).sum())
    faces, place = mesh.faces, "constant/polyMesh"
    note = (
        f"nPoints:{faces.vertex_count}  nCells:{mesh.cell_count}  "
        f"nFaces:{faces.face_count}  nInternalFaces:{inner}"
    )
    points = "\n".join(f"({line})" for line in rows(faces.vertices).split("\n"))
    patch = (
        f"1\n(\n    {PATCH}\n    {{\n        type patch;\n"
        f"        nFaces {faces.face_count - inner};\n        startFace {inner};\n    }}\n)\n"
    )
    texts = {
        f"{place}/points": _header("vectorField", "points", place)
        + _list(faces.vertex_count, points),
        f"{place}/faces": _header("faceList", "faces", place)
        + _list(faces.face_count, lists(faces.face_offsets, faces.face_vertices, "(", ")")),
        f"{place}/owner": _header("labelList", "owner", place, note)
        + _list(faces.face_count, rows(mesh.owner[:, None])),
        f"{place}/neighbour": _header("labelList", "neighbour", place, note)
        + _list(inner, rows(mesh.neighbour[:inner, None])),
        f"{place}/boundary": _header("polyBoundaryMesh", "boundary", place) + patch,
        **{
            f"system/{name}": _header("dictionary", name, "system") + text
            for name, text in SYSTEM.items()
        },
    }
    return {path: text.encode("ascii") for path, text in texts.items()}
