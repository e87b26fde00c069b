"""The options of stage sphere-train."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from . import contract
from .contract import MAX_FACES, Positive, Range, Share
from .errors import UsageError

if TYPE_CHECKING:
    from .surface.spacing import Spacing

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
"""What an option that is not given is, by kind of faces or by preset; what stands in none of them
is not asked for there."""


@dataclass(frozen=True)
class Params(contract.Params):
    """Options of the sphere-train stage."""

    faces: Literal["triangle", "polygon"] = "triangle"
    """Triangles, or polygons that are merged of them and conform exactly as they do."""
    preset: Literal["default", "paper"] = "default"
    """paper: Adam on the initial surface with its losses and weights of 10, 10, 1 and 0.1;
    triangles are then polygons split at their centroids."""
    edge_length: Annotated[float, Range(0.05, 10)] | None = None
    """Edge length of the triangles, 0.55 h0 by default, shorter where the shape is thin; polygons
    are merged of them."""
    polygon_share: Share = 1.0
    """The most of the area that polygons may cover, as a share (polygons)."""
    spacing_min: Annotated[float, Range(0.01, 10)] | None = None
    """Least edge length in h0; with this or the next two, edges are short where the shape bends, is
    thin or has creases close to each other, and long elsewhere."""
    spacing_max: Annotated[float, Range(0.01, 100)] | None = None
    """Largest edge length in h0."""
    faces_target: Annotated[int, Range(100, 10_000_000)] | None = None
    """How many triangles there are to be, within 5 %; with --refine the most. Polygons are merged
    of so many."""
    max_faces: Annotated[int, Range(100, 100_000_000)] = MAX_FACES
    """The most triangles that thin parts and gaps may ask for; a shape that needs more is refused
    before the training."""
    allow_uncertified: bool = False
    """Write the interface of the diagram where the triangles get no certificate, in place of ending
    with an error."""
    refine: Annotated[float, Range(1e-6, 10)] | None = None
    """Distance from the shape in h0 from which on triangles are divided and trained again."""
    iterations: Annotated[int, Range(0, 1_000_000)] | None = None
    """Gauss-Newton steps on triangles, 25 by default; 800 Adam iterations of the paper."""
    learning_rate: Positive | None = None
    """First Adam step of the paper's training, 0.01 h0; decays to 0 as a cosine."""
    weight_intersection: Positive | None = None
    """Weight of the sphere-intersection loss; for triangles, of pairs that are to exist."""
    weight_exclusion: Positive | None = None
    """Weight of the exclusion loss."""
    weight_shape: Positive | None = None
    """Weight of the shape loss."""
    weight_normal: Positive | None = None
    """Weight of normal consistency; for triangles, of vertices at the height of their
    neighbours."""
    weight_smooth: Positive = 0.02
    """Weight of vertices amid their neighbours, along the surface."""
    weight_radius: Positive = 0.02
    """Weight of radii near the mean of their neighbours', or that suit the polygons."""
    shape_loss: Literal["distance", "level-set", "chamfer", "images"] | None = None
    """Distance to the surface (the default), or, trained as in the paper, its own: level-set for
    fields, Chamfer for meshes, images for views (the default of the preset)."""
    target_samples: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points sampled on an input mesh for the Chamfer loss."""
    sharp: str = "auto"
    """Edges along the creases of meshes, points and fields: auto, from 40 degrees on (not in the
    paper's training), off, or the least angle in degrees."""
    merge: Positive = 0.1
    """Vertices of the paper's diagram this near to a trained one, in units of h0, become it in the
    written surface, so that slivers between polygons vanish; 0 writes them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.preset == "default" and self.shape_loss not in (None, "distance"):
            raise UsageError(
                f"--shape-loss {self.shape_loss}: this training is on the distance; add "
                "--preset paper"
            )
        if self.by_adam and self.sharp not in ("auto", "off"):
            raise UsageError(f"--sharp {self.sharp}: the paper's training has no creases")
        _ = self.angle
        for name in ("spacing_min", "spacing_max", "faces_target", "refine"):
            if getattr(self, name) is not None and self.by_adam:
                raise UsageError(f"--{name.replace('_', '-')}: not used with --preset paper")
        if self.polygon_share < 1 and (self.by_adam or self.faces == "triangle"):
            raise UsageError("--polygon-share: only polygons have one; add --faces polygon")
        low, high = self.spacing_min, self.spacing_max
        if low is not None and high is not None and low > high:
            raise UsageError(f"--spacing-min {low:g}: more than --spacing-max {high:g}")
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
        """Degrees from which on an edge of the input is a crease. Raises UsageError."""
        if self.sharp == "off":
            return None
        if self.sharp == "auto":
            from .sources.creases import ANGLE

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
        """What was given for ``name``, or its default."""
        given = getattr(self, name)
        return float(DEFAULTS[self.kind][name] if given is None else given)

    @property
    def spacing(self) -> Spacing:
        """The edge lengths of the triangles; refined ones start with half of their number."""
        from .surface.spacing import Spacing

        faces = self.faces_target
        if faces is not None and self.refine is not None:
            faces //= 2
        return Spacing(
            self.value("edge_length"), self.spacing_min, self.spacing_max, faces, self.max_faces
        )

    def weights(self, *names: str) -> dict[str, float]:
        return {name: self.value(f"weight_{name}") for name in names}
