"""A point cloud as a source: the closed surface that it samples stands for it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...formats import packed
from ...formats.cloud_file import MOST, LoadedCloud, load
from ...mesh.creases import Chain
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats, PolygonMesh
from ...mesh.queries.true_surface import TrueSurface
from ...mesh.topology import topology
from ..mesh.triangle_source import TriangleSource
from ..source import MeasuredPoints
from .reconstruction import AGREE, Reconstruction, reconstruct

WORTH_SAYING = 5e-3
"""Share of the points."""


class PointSource(TriangleSource):
    """Points from a file, with or without normals."""

    kind = "points"
    path: Path

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, packed.stem(path)
        self.columns: str | None = None
        self.given_noise: float | None = None

    @cached_property
    def cloud(self) -> LoadedCloud:
        """Raises InputError for a file that holds none."""
        return load(self.path, self.columns)

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Raises InputError for points that have no inside."""
        try:
            return reconstruct(
                self.cloud.points, self.cloud.normals, self.given_noise, self.threads
            )
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from error

    @cached_property
    def polygons(self) -> PolygonMesh:
        found = self.reconstruction
        return PolygonMesh.of_triangles(found.vertices, found.triangles)

    @property
    def options(self) -> frozenset[str]:
        return frozenset({"noise", "columns"})

    def configure(self, values: Mapping[str, Any]) -> None:
        self.given_noise, self.columns = values["noise"], values["columns"]

    def extra_memory(self) -> float:
        return 350.0 + 3.5e-4 * len(self.cloud.points)

    def measured_points(self) -> MeasuredPoints:
        found = self.reconstruction
        return MeasuredPoints(self.cloud.points, found.kept, found.spacing)

    @property
    def noise(self) -> float:
        """Standard deviation of the points about the surface, in the input's units."""
        return self.reconstruction.noise

    def state(self) -> dict[str, Any]:
        """Arrays of what took long to find."""
        found = self.reconstruction
        return {
            "source/vertices": found.vertices,
            "source/triangles": found.triangles,
            "source/kept": found.kept,
            "source/noise": np.array(found.noise),
            "source/point_spacing": np.array(found.spacing),
            "source/normals_agreement": np.array(
                np.nan if found.agreement is None else found.agreement
            ),
            "source/missed": np.array(found.missed),
            "source/columns": np.array(self.cloud.columns, np.int64),
        }

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Take what ``state`` was, of the same points."""
        agreement = float(stored["source/normals_agreement"])
        self.__dict__["reconstruction"] = Reconstruction(
            stored["source/vertices"],
            stored["source/triangles"],
            float(stored["source/noise"]),
            float(stored["source/point_spacing"]),
            stored["source/kept"],
            None if np.isnan(agreement) else agreement,
            float(stored["source/missed"]),
        )
        self.columns = ",".join(map(str, stored["source/columns"])) or None

    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        """``count`` of the points that do not lie out, all of them if there are fewer."""
        points = self.cloud.points[self.reconstruction.kept]
        if len(points) <= count:
            return points
        return np.asarray(points[random.choice(len(points), count, replace=False)])

    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """Rounded ones: the surface of points has noise."""
        return self._creases(surface, frame, angle, exact=False)

    def describe(self) -> dict[str, Any]:
        found, facts = self.reconstruction, topology(self.polygons)
        return {
            "kind": self.kind,
            "name": self.name,
            "points": len(self.cloud.points),
            "not_finite": self.cloud.not_finite,
            "doubled": self.cloud.doubled,
            "thinned": self.cloud.thinned,
            "outliers": int((~found.kept).sum()),
            "noise": found.noise,
            "noise_given": self.given_noise is not None,
            "point_spacing": found.spacing,
            "normals": self.cloud.normals is not None,
            "normals_agreement": found.agreement,
            "missed": found.missed,
            "euler_number": facts.euler_number,
            "components": facts.components,
        }

    def warnings(self) -> list[str]:
        found, cloud = self.reconstruction, self.cloud
        out = int((~found.kept).sum())
        said = [cloud.note] if cloud.note else []
        said += [
            f"{count} points {what}"
            for count, what in (
                (cloud.not_finite, "have coordinates that are not finite; they are left out"),
                (cloud.thinned, f"are left out at random, since there are more than {MOST}"),
                (out, "are outliers, alone or in a thin cloud, and are left out"),
            )
            if count
        ]
        if found.missed > WORTH_SAYING:
            said.append(
                f"{100 * found.missed:.1f} % of the points are not on the surface made "
                "of them: parts that are sampled too sparsely, or are too thin, are "
                "lost"
            )
        if found.agreement is not None and found.agreement < AGREE:
            said.append(
                f"the given normals are not used: {100 * found.agreement:.0f} % of "
                "them agree with the winding number that they make, and "
                f"{100 * AGREE:.0f} % are needed"
            )
        return said
