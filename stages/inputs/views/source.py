"""Calibrated views as a source: the closed surface that fits their masks and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...artifacts.randomness import generator
from ...errors import InputError
from ...mesh.creases import Chain
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats, Ints, PolygonMesh
from ...mesh.queries.true_surface import TrueSurface
from ...mesh.topology import topology
from ...progress import Progress
from ...render.cameras import Camera
from ...render.views import COVERED, Views
from ..mesh.triangle_source import TriangleSource
from . import alignment, files, pictures
from .fit import fit, levels
from .hull import VisualHull, signed_distances
from .overlap import overlaps
from .silhouettes import PLAIN, Reading, parse_background

CELLS = 96
"""Along the longest side of the grid that the hull is found on."""
MOST_EDT = 512
"""Pixels along a side at which the masks are fitted; larger ones are shrunk."""
DISAGREE = 0.9
"""Intersection over union of a mask and the surface, as seen, below which the view is named."""
NAMED = 3


class ViewSource(TriangleSource):
    """Pictures with cameras and masks, with or without normal maps."""

    kind = "views"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = files.name_of(path)
        self.found = files.read(path)
        self.votes = 0
        self.reading = PLAIN
        self.fit: alignment.Fit | None = None
        self._restored = False
        self.tick = lambda: None
        self._agreement: Floats | None = None

    @property
    def options(self) -> frozenset[str]:
        return frozenset({"mask_votes", "invert_masks", "background", "enclosed"})

    def configure(self, values: Mapping[str, Any]) -> None:
        """Raises UsageError for a background that is no colour."""
        self.votes = values["mask_votes"]
        background = parse_background(values["background"] or "auto")
        self.reading = Reading(
            background, values["enclosed"] == "background", values["invert_masks"]
        )

    def prepare(self, progress: Progress) -> None:
        """Fit the surface to the views."""
        progress.start("fit to the views", sum(level.rounds for level in levels(self.views)))
        done = 0

        def tick() -> None:
            nonlocal done
            done += 1
            progress.advance(done)

        self.tick = tick
        self.polygons  # noqa: B018
        progress.finish()

    def extra_memory(self) -> float:
        return 450.0 + 2e-5 * self.views.masks.size

    @cached_property
    def views(self) -> Views:
        """The masks and normals, opened, orthographic ones made to agree. Raises InputError."""
        views = pictures.load(self.found, self.threads, self.reading)
        if not self._restored:
            self.fit, said = alignment.fit(views, self.names, self.votes, self.threads)
            views = replace(views, notes=(*views.notes, *said))
        return self.fit.applied(views) if self.fit is not None else views

    @cached_property
    def names(self) -> list[str]:
        return [shot.name for shot in self.found.shots]

    @property
    def up(self) -> str:
        """The axis, y or z, that points up in most of the pictures."""
        upward = np.sum([shot.camera.rotation[1] for shot in self.found.shots], axis=0)
        return "y" if abs(upward[1]) > abs(upward[2]) else "z"

    @cached_property
    def polygons(self) -> PolygonMesh:
        """Raises InputError when the silhouettes do not meet."""
        try:
            vertices, triangles = self._reconstructed()
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from error
        return PolygonMesh.of_triangles(vertices, triangles)

    def _reconstructed(self) -> tuple[Floats, Ints]:
        centre, size = self._whereabouts()
        factor = max(1, round(max(self.views.masks.shape[1:]) / MOST_EDT))
        views = self.views.shrunk(factor)
        hull = VisualHull(views.in_frame(centre, size), self.names, self.votes, self.threads)
        vertices, triangles = hull.surface(hull.box(), CELLS)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        side = float((high - low).max())
        centre, size = centre + size * 0.5 * (low + high), size * side
        vertices = (vertices - 0.5 * (low + high)) / side
        placed = views.in_frame(centre, size)
        vertices, triangles = fit(
            vertices, triangles, placed, signed_distances(placed, self.threads), self.votes > 0,
            generator(0, "views", "fit", 0), self.threads, self.tick,
        )  # fmt: skip
        return centre + size * vertices, triangles

    def _whereabouts(self) -> tuple[Floats, float]:
        """About where the object is, and how large: where the rays through the middles of the
        masks come closest to each other, in units in which all that follows is done."""
        origins, ways = [], []
        for camera, mask in zip(self.views.cameras, self.views.masks, strict=True):
            middle = np.argwhere(mask >= COVERED).mean(axis=0)[::-1] + 0.5
            origins.append(start_of(camera, middle))
            ways.append(camera.rays(middle[None])[0])
        way = np.array(ways)
        across = np.eye(3) - way[:, :, None] * way[:, None]
        total = across.sum(axis=0)
        if np.linalg.cond(total) > 1e9:
            raise InputError("all views look along one line; add views from other sides")
        centre = np.linalg.solve(total, np.einsum("nij,nj->i", across, np.array(origins)))
        extent = [
            camera.size_of_pixel(centre[None])[0]
            * np.ptp(np.argwhere(mask >= COVERED), axis=0).max()
            for camera, mask in zip(self.views.cameras, self.views.masks, strict=True)
        ]
        size = float(np.median(extent))
        if not size > 0:
            raise InputError("the views do not look at one place; check the cameras")
        return centre, size

    def agreement(self) -> Floats:
        """Intersection over union of each mask and the surface, as that camera sees it ``(N,)``."""
        if self._agreement is None:
            self._agreement = overlaps(self.views, self.vertices, self.triangles)
        return self._agreement

    def state(self) -> dict[str, Any]:
        """Arrays of what took long to find."""
        kept: dict[str, Any] = {
            "source/vertices": self.vertices,
            "source/triangles": self.triangles,
            "source/agreement": self.agreement(),
            "source/inverted": np.array(self.reading.inverted),
            "source/openings": np.array(self.reading.openings),
        }
        if self.reading.background is not None:
            kept["source/background"] = np.array(self.reading.background, np.int64)
        if self.fit is not None:
            kept["source/scale"], kept["source/shift"] = self.fit.scale, self.fit.shift
        return kept

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Take what ``state`` was, of the same views."""
        self.__dict__["polygons"] = PolygonMesh.of_triangles(
            stored["source/vertices"], stored["source/triangles"]
        )
        self._agreement = stored["source/agreement"]
        self._restored = True
        background = None
        if "source/background" in stored:
            red, green, blue = stored["source/background"].tolist()
            background = red, green, blue
        self.reading = Reading(
            background, bool(stored["source/openings"]), bool(stored["source/inverted"])
        )
        if "source/scale" in stored:
            self.fit = alignment.Fit(stored["source/scale"], stored["source/shift"])

    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """None: a surface fitted to views does not show them."""
        return []

    def describe(self) -> dict[str, Any]:
        facts, agreement = topology(self.polygons), self.agreement()
        return {
            "kind": self.kind,
            "name": self.name,
            "layout": self.found.layout,
            "views": len(self.names),
            "width": self.views.cameras[0].width,
            "height": self.views.cameras[0].height,
            "orthographic": self.views.cameras[0].orthographic,
            "up": self.up,
            "normals": self.views.normals is not None,
            "mask_votes": self.votes,
            "fit": None
            if self.fit is None
            else {
                "largest_scale": float(np.exp(np.abs(np.log(self.fit.scale)).max())),
                "largest_shift": float(np.linalg.norm(self.fit.shift, axis=1).max()),
                "scale": dict(zip(self.names, self.fit.scale.tolist(), strict=True)),
                "shift": dict(zip(self.names, self.fit.shift.tolist(), strict=True)),
            },
            "mask_overlap_mean": float(agreement.mean()),
            "mask_overlap_worst": float(agreement.min()),
            "euler_number": facts.euler_number,
            "components": facts.components,
        }

    def warnings(self) -> list[str]:
        said = list(self.views.notes)
        agreement = self.agreement()
        bad = np.flatnonzero(agreement < DISAGREE)
        if len(bad):
            worst = bad[np.argsort(agreement[bad], kind="stable")][:NAMED]
            named = ", ".join(f"{self.names[v]} ({agreement[v]:.2f})" for v in worst)
            said.append(
                f"{len(bad)} of {len(self.names)} masks do not fit the surface; the "
                f"worst are {named}: check them, or raise --mask-votes"
            )
        if self.views.normals is None:
            said.append("there are no normal maps: hollows that no silhouette shows are filled in")
        return said


def start_of(camera: Camera, pixel: Floats) -> Floats:
    """A point on the ray through ``pixel (2,)``."""
    if not camera.orthographic:
        return camera.position
    flat = np.linalg.solve(camera.matrix[:2, :2], pixel - camera.matrix[:2, 2])
    return np.asarray(camera.rotation.T @ (np.append(flat, 0.0) - camera.translation))
