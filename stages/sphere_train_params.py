"""The options of stage sphere-train."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from .engine.params import Positive, Range, Share, StageParams
from .errors import UsageError

if TYPE_CHECKING:
    from .remesh.target_lengths import Spacing

DEFAULTS: dict[str, dict[str, float]] = {
    "triangle": {
        "edge_length": 0.55,
        "iterations": 25,
        "weight_intersection": 30.0,
        "weight_exclusion": 30.0,
        "weight_shape": 100.0,
        "weight_normal": 0.0,
    },
    "paper": {
        "iterations": 800,
        "learning_rate": 0.01,
        "weight_intersection": 10.0,
        "weight_exclusion": 10.0,
        "weight_shape": 1.0,
        "weight_normal": 0.1,
    },
}
"""Defaults of options for the default training and for the paper's. An option that is missing from
one of them does not apply there."""


MAX_FACES = 400_000
"""Triangles that a surface may need, unless more are asked for."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the sphere-train stage."""

    faces: Literal["triangle", "polygon"] = "triangle"
    """The faces of the surface: triangles, or polygons that are merged of certified triangles."""
    preset: Literal["default", "paper"] = "default"
    """paper trains the first surface with Adam and with the losses and weights of the paper.
    Triangles are then polygons split at their centroids."""
    edge_length: Annotated[float, Range(0.05, 10)] | None = None
    """Edge length of the triangles in units of the voxel edge h0. Default: 0.55. Edges are shorter
    where the shape is thin."""
    polygon_share: Share = 1.0
    """Largest share of the area that polygons may cover, with --faces polygon."""
    spacing_min: Annotated[float, Range(0.01, 10)] | None = None
    """Smallest edge length in h0. With this option or the next two, edges are short where the shape
    bends, is thin or has close creases, and long elsewhere."""
    spacing_max: Annotated[float, Range(0.01, 100)] | None = None
    """Largest edge length in h0."""
    faces_target: Annotated[int, Range(100, 10_000_000)] | None = None
    """Number of triangles, within 5 %; with --refine the maximum. Polygons are merged of these
    triangles."""
    max_faces: Annotated[int, Range(100, 100_000_000)] = MAX_FACES
    """Maximum number of triangles. A shape whose thin parts and gaps need more is refused before
    the training."""
    allow_uncertified: bool = False
    """If the triangles get no certificate, write the interface of the diagram in place of ending
    with an error."""
    refine: Annotated[float, Range(1e-6, 10)] | None = None
    """Divide triangles that are further than this from the shape, in h0, and train them again."""
    iterations: Annotated[int, Range(0, 1_000_000)] | None = None
    """Number of Gauss-Newton steps. Default: 25, or 800 Adam iterations with --preset paper."""
    learning_rate: Positive | None = None
    """First step of Adam with --preset paper, in h0. Default: 0.01. It falls to 0 along a
    cosine."""
    weight_intersection: Positive | None = None
    """Weight of the sphere-intersection loss: the spheres of a face must meet."""
    weight_exclusion: Positive | None = None
    """Weight of the exclusion loss: no generator may lie in the sphere of another face."""
    weight_shape: Positive | None = None
    """Weight of the shape loss."""
    weight_normal: Positive | None = None
    """Weight of normal consistency. For triangles it keeps vertices at the height of their
    neighbours."""
    weight_smooth: Positive = 0.02
    """Weight that draws vertices to the middle of their neighbours, along the surface."""
    weight_radius: Positive = 0.02
    """Weight that keeps each radius close to those of its neighbours."""
    shape_loss: Literal["distance", "level-set", "chamfer", "images"] | None = None
    """The shape loss. Default: distance to the surface; with --preset paper, level-set for fields,
    chamfer for meshes and points, images for views."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Number of points sampled on a mesh for the Chamfer loss."""
    sharp: str = "auto"
    """Make edges follow the creases of meshes, points and fields: auto for creases of 40 degrees or
    more, another smallest angle in degrees, or off. --preset paper ignores creases."""
    merge: Positive = 0.1
    """With --preset paper and polygons: merge vertices of the diagram within this distance, in h0,
    of a trained vertex, so that slivers vanish. 0 keeps them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.preset == "default" and self.shape_loss not in (None, "distance"):
            raise UsageError(
                f"--shape-loss {self.shape_loss}: the default training uses the distance "
                "only; add --preset paper"
            )
        if self.by_adam and self.sharp not in ("auto", "off"):
            raise UsageError(
                f"--sharp {self.sharp}: --preset paper does not follow creases; leave it out"
            )
        _ = self.angle
        for name in ("spacing_min", "spacing_max", "faces_target", "refine"):
            if getattr(self, name) is not None and self.by_adam:
                raise UsageError(f"--{name.replace('_', '-')}: not used with --preset paper")
        if self.polygon_share < 1 and (self.by_adam or self.faces == "triangle"):
            raise UsageError(
                "--polygon-share: applies to --faces polygon only, without --preset paper"
            )
        low, high = self.spacing_min, self.spacing_max
        if low is not None and high is not None and low > high:
            raise UsageError(f"--spacing-min {low:g}: more than --spacing-max {high:g}; lower it")
        for name in ("edge_length", "learning_rate"):
            if getattr(self, name) is not None and name not in DEFAULTS[self.kind]:
                other = "add --preset paper" if name == "learning_rate" else "leave it out"
                raise UsageError(f"--{name.replace('_', '-')}: not used in this training; {other}")

    @property
    def by_adam(self) -> bool:
        """Whether the initial surface is trained as in the paper."""
        return self.preset == "paper"

    @property
    def angle(self) -> float | None:
        """Smallest angle in degrees by which an edge of the input bends to be a crease. Raises
        UsageError."""
        if self.sharp == "off":
            return None
        if self.sharp == "auto":
            from .inputs.creases.sharp_edges import ANGLE

            return ANGLE
        try:
            angle = float(self.sharp)
        except ValueError:
            angle = 0.0
        if not 5 <= angle <= 175:
            raise UsageError(f"--sharp {self.sharp}: must be auto, off, or from 5 to 175 degrees")
        return angle

    @property
    def kind(self) -> str:
        """The row of DEFAULTS."""
        return "paper" if self.by_adam else "triangle"

    def value(self, name: str) -> float:
        """The given value of ``name``, or its default."""
        given = getattr(self, name)
        return float(DEFAULTS[self.kind][name] if given is None else given)

    @property
    def spacing(self) -> Spacing:
        """The edge lengths of the triangles. With --refine the training starts with half of their
        number."""
        from .remesh.target_lengths import Spacing

        faces = self.faces_target
        if faces is not None and self.refine is not None:
            faces //= 2
        return Spacing(
            self.value("edge_length"), self.spacing_min, self.spacing_max, faces, self.max_faces
        )

    def weights(self, *names: str) -> dict[str, float]:
        return {name: self.value(f"weight_{name}") for name in names}
