"""Check that a written surface is closed, made on the file as it is read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import NumericalFailure
from ..formats import ply
from ..mesh.geometry import enclosed_volume, fan_triangles
from ..mesh.topology import Topology, topology


def as_written(paths: dict[str, Path], certified: Topology | None = None) -> dict[str, Any]:
    """Read the PLY among the written files back, and return figures of its topology.

    If the certificate holds, the written surface is the trained one, whose topology is
    ``certified``. Raises NumericalFailure unless every edge is in exactly two faces with opposite
    directions, the normals point outward, and the topology is the certified one.
    """
    mesh = ply.read(paths["ply"])
    if mesh is None:
        raise NumericalFailure(f"{paths['ply'].name}: cannot be read back")
    facts = topology(mesh)
    volume = enclosed_volume(*fan_triangles(mesh)[:2])
    if not facts.closed:
        raise NumericalFailure(
            f"the surface is not closed: {facts.bad_edges} edges are not in two faces; "
            "change -n a little and run again"
        )
    if volume <= 0:
        raise NumericalFailure(
            "the surface faces inward, since inside and outside are swapped; please report this"
        )
    if certified is not None and facts != certified:
        raise NumericalFailure(
            f"{paths['ply'].name} has Euler number {facts.euler_number} and {facts.components} "
            f"components, the certified surface {certified.euler_number} and "
            f"{certified.components}: please report this"
        )
    return {
        "closed": True,
        "faces": facts.faces,
        "euler_number": facts.euler_number,
        "components": facts.components,
        "certified_topology": certified is not None,
    }
