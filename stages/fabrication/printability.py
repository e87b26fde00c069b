"""Checks of whether an object will print, each with a verdict and the worst places."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..mesh.geometry import triangle_areas, triangle_normals
from ..mesh.polygons import Floats, Ints
from . import layers
from .base import TILT, Balance
from .tubes import TubeGraph

WORST = 5
"""Number of places that are stored for each check."""
BRIDGE = 10.0
"""Length in mm that a printer spans without support; longer bridges sag."""
LEVEL = 15.0
"""A tube that rises by fewer degrees than this is a bridge."""
STEEP, FLAT = 45.0, 70.0
"""Angles from upright, in degrees, above which a downward side is an
overhang, or nearly a ceiling."""
MOST_FLAT = 0.2
"""Share of the surface that may be nearly a ceiling without a warning."""
SEALED = 0.01
"""Share of the faces that tubes may close without a warning."""
THIN = 1e-3
"""Length in mm by which rounding to 32 bits may make a wall thinner."""
ALONG = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Positions along a tube's axis, from 0 to 1, at which its thickness is measured."""


@dataclass(frozen=True)
class Check:
    """The result of one check. ``verdict`` is one of ok, warn, fail and not run."""

    name: str
    verdict: str
    value: float | None
    limit: float | None
    unit: str
    text: str
    worst: list[list[float]] = field(default_factory=list)
    """Places (x, y, z) in mm, the worst first."""

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def _places(points: Iterable[Any]) -> list[list[float]]:
    return [[round(float(x), 3) for x in point] for point in list(points)[:WORST]]


def wall(
    vertices: Floats,
    triangles: Ints,
    axes: Floats,
    plates: Floats,
    plate_thickness: float,
    nozzle: float,
    layer: float,
) -> list[Check]:
    """The thickness of tubes and plates, measured on the finished mesh.

    It is twice the distance from a point of a tube's axis, or from the middle of a plate, to the
    surface. ``axes`` are points of tube axes that lie inside the object.
    """
    from ..mesh.queries.triangle_tree import TriangleTree

    tree = TriangleTree(vertices, triangles)
    found = []
    for name, points, limit, wanted in (
        ("tubes", axes, 2 * nozzle, None),
        ("plates", plates, 2 * layer, plate_thickness),
    ):
        if len(points) == 0:
            continue
        thickness = 2 * np.sqrt(tree.closest(points)[0])
        order = np.argsort(thickness)
        least = float(thickness[order[0]])
        thin = int((thickness < limit - THIN).sum())
        text = f"thinnest {least:.2f} mm, at least {limit:g} mm required"
        if wanted is not None:
            text += f" (asked for {wanted:g})"
        verdict, worst = "fail" if thin else "ok", _places(points[order])
        found.append(Check(name, verdict, round(least, 4), limit, "mm", text, worst))
    return found


def shell(distances: Floats, wall: float) -> Check:
    """The thickness of a shell's wall. ``distances (N,)`` are those of the inner
    vertices from the outer side."""
    least = float(distances.min())
    return Check(
        "shell", "ok" if least >= wall - THIN else "fail", round(least, 4), wall, "mm",
        f"thinnest {least:.2f} mm, at least {wall:g} mm required",
    )  # fmt: skip


def axis_points(graph: TubeGraph, keep: Any) -> Floats:
    """Points ``(P, 3)`` on the tubes' axes for which ``keep(points)`` holds."""
    ends = graph.nodes[graph.tubes]
    points = np.concatenate([(1 - t) * ends[:, 0] + t * ends[:, 1] for t in ALONG])
    return np.asarray(points[keep(points)])


def bridges(graph: TubeGraph, keep: Any) -> Check:
    """The spans of tubes that are nearly level."""
    ends = graph.nodes[graph.tubes]
    along = ends[:, 1] - ends[:, 0]
    across = np.linalg.norm(along[:, :2], axis=1)
    rise = np.degrees(np.arctan2(np.abs(along[:, 2]), across))
    level = np.flatnonzero((rise < LEVEL) & keep(ends.mean(axis=1)))
    order = level[np.argsort(-across[level], kind="stable")]
    longest = float(across[order[0]]) if len(order) else 0.0
    long = int((across[level] > BRIDGE).sum())
    return Check(
        "bridges", "warn" if long else "ok", round(longest, 3), BRIDGE, "mm",
        (
        f"the longest of {len(level)} nearly level tubes is {longest:.1f} mm; {long} are "
        f"longer than {BRIDGE:g} mm"
        ),
        _places(ends.mean(axis=1)[order]),
    )  # fmt: skip


def floating(graph: TubeGraph, keep: Any) -> Check:
    """Nodes of the tubes without a lower neighbour, which the printer begins in the air."""
    start, stop = graph.tubes.T
    z = graph.nodes[:, 2]
    lowest = np.full(len(z), np.inf)
    np.minimum.at(lowest, start, z[stop])
    np.minimum.at(lowest, stop, z[start])
    hanging = np.flatnonzero((z < lowest) & np.isfinite(lowest) & keep(graph.nodes))
    order = hanging[np.argsort(z[hanging] - lowest[hanging], kind="stable")]
    return Check(
        "floating starts", "warn" if len(order) else "ok", float(len(order)), 0.0, "nodes",
        f"{len(order)} of {len(z)} nodes have no lower neighbour, so they begin in the air",
        _places(graph.nodes[order]),
    )  # fmt: skip


def layered(vertices: Floats, triangles: Ints, layer: float, nozzle: float) -> list[Check]:
    """Islands and empty layers of the finished mesh."""
    found = layers.islands(vertices, triangles, layer, nozzle)
    widest = float(found.areas[0]) if len(found.areas) else 0.0
    return [
        Check(
            "islands", "warn" if len(found.areas) else "ok", float(len(found.areas)), 0.0, "",
            f"{len(found.areas)} parts of layers begin in the air, the widest {widest:.1f} mm2",
            _places(found.places),
        ),
        Check(
            "layers", "fail" if found.empty_layers else "ok", float(found.layers), None, "",
            f"{found.layers} layers of {layer:g} mm, {found.empty_layers} of them empty",
        ),
    ]  # fmt: skip


def overhangs(vertices: Floats, triangles: Ints) -> Check:
    """The shares of the surface that face down by more than STEEP and by more than FLAT.

    Parts that stand on the floor do not count.
    """
    area = triangle_areas(vertices, triangles)
    normal = triangle_normals(vertices, triangles)[0]
    middle = vertices[triangles].mean(axis=1)
    down = (normal[:, 2] < 0) & (middle[:, 2] > vertices[:, 2].min() + 1e-3)
    # For a side at an angle from upright, the normal's downward part is the sine of the angle.
    steep = down & (-normal[:, 2] > np.sin(np.radians(STEEP)))
    flat = down & (-normal[:, 2] > np.sin(np.radians(FLAT)))
    total = float(area.sum())
    shares = [float(area[which].sum()) / total for which in (steep, flat)]
    ceiling = np.flatnonzero(flat)
    order = ceiling[np.argsort(-area[ceiling], kind="stable")]
    return Check(
        "overhangs", "warn" if shares[1] > MOST_FLAT else "ok", round(shares[1], 4), MOST_FLAT,
        "share",
        f"{100 * shares[0]:.0f} % of the surface hangs over by {STEEP:g} degrees or more, "
        f"{100 * shares[1]:.0f} % by {FLAT:g}",
        _places(middle[order]),
    )  # fmt: skip


def sealed(centres: Floats, sizes: Floats, count: int) -> Check:
    """The faces that tubes close. ``sizes`` are their openings, negative where tubes overlap.

    A few of them at a tip do no harm: panes close them, as plates do.
    """
    order, most = np.argsort(sizes, kind="stable"), SEALED * count
    return Check(
        "sealed faces", "warn" if len(order) > most else "ok", float(len(order)), most, "faces",
        f"{len(order)} of {count} faces are narrower than the nozzle and are closed",
        _places(centres[order]),
    )  # fmt: skip


def bed(size: tuple[float, float, float], room: tuple[float, float, float]) -> Check:
    """Whether the object fits the printer, possibly turned by a right angle."""
    fits = (
        sorted(size[:2])[0] <= sorted(room[:2])[0]
        and sorted(size[:2])[1] <= sorted(room[:2])[1]
        and size[2] <= room[2]
    )
    return Check(
        "bed", "ok" if fits else "fail", round(max(size), 2), max(room), "mm",
        (
        f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, room for {room[0]:g} x "
        f"{room[1]:g} x {room[2]:g} mm"
        ),
    )  # fmt: skip


def stability(found: Balance) -> Check:
    """The angle to which the object can be tilted before it falls."""
    tilt = found.tilt_degrees
    verdict = "fail" if tilt <= 0 else "ok" if tilt >= TILT else "warn"
    return Check(
        "stability", verdict, round(tilt, 2), TILT, "degrees",
        f"stands until tilted by {tilt:.0f} degrees" if tilt > 0
        else "its centre of mass is not over its base: it falls",
        _places([found.centre]),
    )  # fmt: skip


def openness(share: float) -> Check:
    """The share of the surface that neither plates nor tubes cover, and that lets light out."""
    return Check(
        "open area", "ok" if share >= 0.1 else "warn", round(share, 4), 0.1, "share",
        f"{100 * share:.0f} % of the surface is open",
    )  # fmt: skip
