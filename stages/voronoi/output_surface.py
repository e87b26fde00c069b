"""The surface that the sphere-train stage writes.

It is the trained surface if the certificate holds, else the interface of its generators.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mesh.polygons import Ints, PolygonMesh
from ..mesh.topology import topology
from .certificate import Certificate
from .conformity import Conformity, conformity
from .diagram.cleanup import CleanSurface, clean
from .diagram.vertices import FLAT
from .trained_surface import TrainedSurface

MERGE = 1e-4
"""Shorter edges of the diagram, in units of h0, are contracted before its faces are counted."""


@dataclass(frozen=True)
class Written:
    """The surface to write, and the results of the checks."""

    mesh: PolygonMesh
    bounds: Ints
    """The trained faces of the inside and the outside generator of each face, ``(F, 2)``."""
    certificate: Certificate
    conformity: Conformity
    cleaned: CleanSurface
    faces_after_merging: int
    """Number of faces of the diagram after its edges shorter than MERGE were contracted."""
    merged_within: float
    """Largest distance by which a vertex was moved to remove thin faces, in units of h0."""

    def facts(self) -> dict[str, Any]:
        """The figures for the manifest."""
        return {
            "certificate": vars(self.certificate) | {"failed": list(self.certificate.failed)},
            "conformity": vars(self.conformity),
            "faces_after_merging": self.faces_after_merging,
            "written_faces": self.mesh.face_count,
            "merged_within": self.merged_within,
            "cleanup": {
                "dropped_flat": self.cleaned.dropped_flat,
                "merged_vertices": self.cleaned.merged_vertices,
                "dropped_faces": self.cleaned.dropped_faces,
                "kept_degenerate": self.cleaned.kept_degenerate,
            },
        }

    def warnings(self, count: int, merge: float) -> list[str]:
        """Warnings for the manifest about ``count`` trained faces without a certificate."""
        if self.certificate.holds:
            return []
        said = []
        if self.conformity.pair_faces < count:
            said.append(
                f"{count - self.conformity.pair_faces} of {count} trained faces are missing "
                "in the written surface, since the diagram has no face between their "
                "generators"
            )
        merged = ""
        if merge and self.merged_within:
            merged = f", with slivers merged within {self.merged_within:.3f} h0"
        elif merge:
            merged = ", with its slivers, since merging them would change its topology"
        said.append(
            f"no certificate ({', '.join(self.certificate.failed)} fails): the written "
            f"surface is the interface of the generators{merged}; "
            f"{100 * self.conformity.pair_area_share:.2f} % of its area lies between "
            "generator pairs"
        )
        return said


def written(
    trained: TrainedSurface, merge: float, threads: int,
    refused: Callable[[Certificate], None] = lambda certificate: None,
) -> Written:  # fmt: skip
    """The trained surface if the certificate holds, else the interface of its generators.

    Vertices of the interface that are within ``merge`` of a trained vertex move to it where the
    topology allows it; 0 moves none. If the certificate does not hold, ``refused`` is called with
    it before the interface is computed.
    """
    certificate = trained.certificate(threads)
    if not certificate.holds:
        refused(certificate)
    raw = trained.interface()
    agreement = conformity(raw, trained, threads)
    compared = clean(raw, spacing=1.0, merge=MERGE)
    if certificate.holds:
        bounds = np.stack([np.arange(trained.face_count)] * 2, axis=1)
        faces = compared.mesh.face_count
        return Written(trained.polygons, bounds, certificate, agreement, compared, faces, 0.0)
    cleaned, within = clean(raw, spacing=1.0), 0.0
    if merge > 0:
        simpler = clean(raw, spacing=1.0, anchors=trained.polygons.vertices, reach=merge)
        facts = [topology(mesh) for mesh in (cleaned.mesh, simpler.mesh)]
        same = len({(f.euler_number, f.components, f.bad_edges, f.pinched_vertices) for f in facts})
        if same == 1:
            source = simpler.vertex_sources
            kept = source >= 0
            moved = simpler.mesh.vertices[source[kept]] - raw.mesh.vertices[kept]
            sound = raw.flatness[kept] > FLAT
            within = float(np.linalg.norm(moved[sound], axis=1).max(initial=0.0))
            cleaned = simpler
    return Written(
        cleaned.mesh,
        trained.faces_of_generators[cleaned.generators],
        certificate,
        agreement,
        cleaned,
        compared.mesh.face_count,
        within,
    )
