"""The file formats of polyhedral meshes, by name.

To add a format, write a module with a function that encodes a mesh, and add a ``Format`` here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..artifacts import hdf5
from ..errors import InputError
from ..mesh.dual_graph import DualGraph
from ..mesh.polygons import Floats
from ..mesh.polyhedra import PolyhedralMesh
from . import disu, graph_files, ovm, ply, poly_mesh, tetrahedra, vtu


@dataclass(frozen=True)
class Volume:
    """What is exported: the cells, data for each cell ``(C,)``, and a point near
    each cell ``(C, 3)``, its generator."""

    mesh: PolyhedralMesh
    data: Mapping[str, Any]
    points: Floats

    @cached_property
    def graph(self) -> DualGraph:
        """The connections of the cells, whose generators are the points."""
        return DualGraph.of(self.mesh, self.points, np.asarray(self.data["volume"]))


@dataclass(frozen=True)
class Format:
    """A file format and the function that writes it."""

    suffix: str
    """Suffix of the file; empty if the format is a folder."""
    about: str
    encode: Callable[[Volume], dict[str, bytes]]
    """A function that returns the bytes of each file by its path in the folder. A single
    file has the path ``""``."""
    inside: str = ""
    """The part of the folder that is replaced as a whole. Other files that exist are kept. If it is
    empty, all files are replaced."""
    remark: Callable[[Volume], str] | None = None
    """A function that returns what to say about the result."""


def _split(volume: Volume) -> tetrahedra.Split:
    found = tetrahedra.split(volume.mesh, volume.points)
    if found.turned:
        raise InputError(
            f"{found.turned} of {len(found.tetrahedra)} tetrahedra have no volume, or a "
            "negative one, since cells near the surface are faulty; lower --sliver of stage "
            "volume, or train the surface until it has a certificate"
        )
    return found


def _vtu_tetrahedra(volume: Volume) -> bytes:
    found = _split(volume)
    data = {name: np.asarray(volume.data[name])[found.cell] for name in ("generator", "role")}
    return vtu.encode_tetrahedra(found.vertices, found.tetrahedra, {"cell": found.cell, **data})


def _ply(volume: Volume) -> bytes:
    mesh = volume.mesh
    outer = mesh.neighbour < 0
    owner = mesh.owner[outer]
    data = {"cell": owner, **{name: np.asarray(volume.data[name])[owner] for name in volume.data}}
    return ply.encode(mesh.boundary.without_unused_vertices(), face_data=data)


def _hdf5(volume: Volume) -> bytes:
    mesh = volume.mesh
    arrays = {
        **mesh.faces.as_arrays(),
        "face_owner": mesh.owner,
        "face_neighbour": mesh.neighbour,
        **{f"cell/{name}": np.asarray(values) for name, values in volume.data.items()},
    }
    return hdf5.encode(None, arrays, {})


def _file(encode: Callable[[Volume], bytes]) -> Callable[[Volume], dict[str, bytes]]:
    return lambda volume: {"": encode(volume)}


def _graph(suffix: str, about: str, encode: Callable[[DualGraph], dict[str, bytes]]) -> Format:
    return Format(
        suffix, about, lambda volume: encode(volume.graph), remark=lambda v: v.graph.remark
    )


FORMATS: dict[str, Format] = {
    "vtu": Format("vtu", "polyhedra for ParaView", _file(lambda v: vtu.encode(v.mesh, v.data))),
    "openfoam": Format(
        "", "an OpenFOAM case", lambda v: poly_mesh.encode(v.mesh), "constant/polyMesh"
    ),
    "ovm": Format("ovm", "OpenVolumeMesh", _file(lambda v: ovm.encode(v.mesh))),
    "vtu-tetrahedra": Format("vtu", "tetrahedra for ParaView", _file(_vtu_tetrahedra)),
    "msh": Format("msh", "Gmsh, tetrahedra", _file(lambda v: tetrahedra.encode_msh(_split(v)))),
    "inp": Format(
        "inp", "Abaqus or CalculiX, tetrahedra", _file(lambda v: tetrahedra.encode_inp(_split(v)))
    ),
    "ply": Format("ply", "the outer faces, also of a cut", _file(_ply)),
    "hdf5": Format("h5", "flat arrays", _file(_hdf5)),
    "graph-csv": _graph("", "the dual graph as tables", graph_files.csv),
    "graph-hdf5": _graph(
        "h5", "the dual graph as arrays", lambda g: {"": graph_files.encode_hdf5(g)}
    ),
    "pflotran": _graph("", "PFLOTRAN's explicit grid", graph_files.pflotran),
    "tough": _graph("", "the MESH of TOUGH", graph_files.tough),
    "modflow": _graph("", "DISU of MODFLOW 6", disu.encode),
}
"""The formats by name. If several have the same suffix, the first is the default for it."""
