"""Orthographic views that were each framed by themselves, scaled and shifted until they agree.

Two of them look across a common axis (the cross product of their directions), along which both
silhouettes must reach equally far. These extents are linear in a scale and two shifts of each view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...errors import InputError
from ...mesh.polygons import Floats
from ...render.cameras import Camera
from ...render.views import COVERED, Views

SLACK_PIXELS, SLACK = 2.5, 0.015
"""Differences of extents, in pixels and of the object's size, that drawing makes: below either
views agree."""
PARALLEL = 1e-3
"""Sine of the angle of two views from which on they have an axis in common, not a plane."""
TURNS = 4
"""Directions, over a half turn, in which the silhouettes of views along one line are compared."""
ROUNDS = 30
"""Of least squares whose weights approach a sum of absolute values, so that one wrong extent does
not move the views which agree."""
ROUNDING = 1e-3
"""Difference, of the object's size, from which on that is so."""
MOST_PAIRS = 3_000
CUT = 0.1
"""Cosine of a direction and that in which an object leaves the picture, above which it is not known
how far it reaches."""
CELLS = 48
"""Of the hull that tells whether a fit is one."""
REMAINS = 0.5
"""Of what the masks have beyond their hull, or it misses, most that a fit may leave."""


@dataclass(frozen=True)
class Fit:
    """``scale (N,)`` and ``shift (N, 2)``, right and down as a share of the picture's width, that
    pictures go through, about their middles."""

    scale: Floats
    shift: Floats

    def __call__(self, camera: Camera, number: int) -> Camera:
        """The camera of the picture as it is, for an object in the common frame."""
        middle = 0.5 * np.array([camera.width, camera.height])
        matrix = camera.matrix.copy()
        matrix[:2, :2] /= self.scale[number]
        moved = matrix[:2, 2] - middle - self.shift[number] * camera.width
        matrix[:2, 2] = middle + moved / self.scale[number]
        return replace(camera, matrix=matrix)

    def applied(self, views: Views) -> Views:
        cameras = tuple(self(camera, number) for number, camera in enumerate(views.cameras))
        return replace(views, cameras=cameras)


def fit(views: Views, names: list[str], votes: int, threads: int) -> tuple[Fit | None, list[str]]:
    """What makes orthographic ``views`` agree, None where they do or nothing does, and sentences
    on it."""
    if not all(camera.orthographic for camera in views.cameras):
        return None, []
    rows = _Rows.of(views)
    if rows is None:
        return None, []
    before = float(np.abs(rows.differences).max())
    if before <= max(SLACK, SLACK_PIXELS * rows.pixel):
        return None, []
    found = rows.solved(views)
    if found is None:
        return None, []
    placed = views.in_frame(rows.centre, rows.size)
    old, new = (_overlap(each, names, votes, threads) for each in (placed, found.applied(placed)))
    if 1 - new > REMAINS * (1 - old):
        return None, [
            f"the silhouettes reach up to {before:.1%} of the object's size further in one view "
            "than in another, and no scales and shifts of the views make them agree"
        ]
    most = int(np.argmax(np.abs(np.log(found.scale))))
    moved = int(np.argmax(np.linalg.norm(found.shift, axis=1)))
    right, down = found.shift[moved]
    return found, [
        f"the silhouettes reached up to {before:.1%} of the object's size further in one view than "
        f"in another, so the views were scaled (most, by {found.scale[most]:.3f}, {names[most]}) "
        f"and shifted (most, by {right:.1%} of the width to the right and {down:.1%} down, "
        f"{names[moved]}): the masks then overlap with their hull by {new:.3f}, not {old:.3f}"
    ]


@dataclass(frozen=True)
class _Rows:
    """Equations: of view ``first (E,)`` and ``second (E,)`` the ``extents (E, 2)`` along unit
    vectors that are ``along (E, 2, 2)`` right and down in either, of the object's size."""

    first: Any
    second: Any
    extents: Floats
    along: Floats
    pixel: float
    size: float
    centre: Floats
    middles: Floats
    """Of the object in the plane of each view ``(N, 2)``, in lengths."""

    @property
    def differences(self) -> Floats:
        return np.asarray(self.extents[:, 0] - self.extents[:, 1])

    @staticmethod
    def of(views: Views) -> _Rows | None:
        count = len(views)
        outlines = [
            _outline(camera, mask) for camera, mask in zip(views.cameras, views.masks, strict=True)
        ]
        cut = [_cut(mask) for mask in views.masks]
        size = float(np.median([np.ptp(outline, axis=0).max() for outline in outlines]))
        # The point that all views have in the middle of the object, as far as may be.
        planes = np.stack([camera.rotation[:2] for camera in views.cameras])
        held = np.stack([camera.translation[:2] for camera in views.cameras])
        middle = np.stack([0.5 * (o.min(axis=0) + o.max(axis=0)) for o in outlines])
        centre = np.linalg.lstsq(
            planes.reshape(-1, 3), (middle - held).reshape(-1), rcond=None
        )[0]  # fmt: skip
        middles = planes @ centre + held
        pairs = np.array([(i, j) for i in range(count) for j in range(i)])
        if len(pairs) > MOST_PAIRS:
            pairs = pairs[:: -(-len(pairs) // MOST_PAIRS)]
        rows = []
        for i, j in pairs.tolist():
            ways = np.cross(views.cameras[i].rotation[2], views.cameras[j].rotation[2])[None]
            if np.linalg.norm(ways) < PARALLEL:
                angle = np.pi * np.arange(TURNS) / TURNS
                ways = np.column_stack([np.cos(angle), np.sin(angle)]) @ planes[i]
            for way in ways / np.linalg.norm(ways, axis=1, keepdims=True):
                for sign in (1.0, -1.0):
                    along = np.stack([planes[k] @ way * sign for k in (i, j)])
                    if any((cut[k] @ a > CUT).any() for k, a in zip((i, j), along, strict=True)):
                        continue
                    reach = [
                        ((outlines[k] - middles[k]) @ a).max() / size
                        for k, a in zip((i, j), along, strict=True)
                    ]
                    rows.append((i, j, reach, along))
        if not rows:
            return None
        first, second, extents, along = (
            np.array(part) for part in zip(*rows, strict=True)
        )  # fmt: skip
        pixel = max(camera.size_of_pixel(np.zeros((1, 3)))[0] for camera in views.cameras) / size
        return _Rows(
            first,
            second,
            extents,
            along,
            float(pixel),
            size,
            np.asarray(centre),
            np.asarray(middles),
        )

    def solved(self, views: Views) -> Fit | None:
        """Scales whose mean is 1 and shifts, as small as may be, that make the sum of differences
        least."""
        from scipy.linalg import block_diag, null_space

        count, number = len(views), np.arange(len(self.first))
        system = np.zeros((len(self.first), 3 * count))
        for side, (view, sign) in enumerate(((self.first, 1.0), (self.second, -1.0))):
            system[number, view] = sign * self.extents[:, side]
            for axis in range(2):
                system[number, (1 + axis) * count + view] = sign * self.along[:, side, axis]
        # Without it all scales would go to zero.
        kept = block_diag(null_space(np.ones((1, count))), np.eye(2 * count))
        reduced = system @ kept
        weight = np.ones(len(number))
        off = self.differences
        change = np.zeros(3 * count)
        for _ in range(ROUNDS):
            root = np.sqrt(weight)
            change = kept @ np.linalg.lstsq(root[:, None] * reduced, -root * off, rcond=1e-9)[0]
            weight = 1 / np.maximum(np.abs(off + system @ change), ROUNDING)
        scale, moved = 1 + change[:count], self.size * change[count:].reshape(2, count).T
        if scale.min() <= 0:
            return None
        shifts = []
        for k, camera in enumerate(views.cameras):
            # In the plane of the view: q -> middle + scale (q - middle) + moved.
            inner = camera.matrix[:2, :2]
            about = inner @ self.middles[k] + camera.matrix[:2, 2]
            middle = 0.5 * np.array([camera.width, camera.height])
            shifts.append((1 - scale[k]) * (about - middle) + inner @ moved[k])
        width = np.array([camera.width for camera in views.cameras])
        return Fit(scale, np.array(shifts) / width[:, None])


def _outline(camera: Camera, mask: Any) -> Floats:
    """Corners of the covered pixels at the convex outline of a mask, in lengths in the plane of the
    view ``(H, 2)``."""
    covered = mask >= COVERED
    rows = np.flatnonzero(covered.any(axis=1))
    left = covered[rows].argmax(axis=1)
    right = covered.shape[1] - covered[rows, ::-1].argmax(axis=1)
    corners = np.concatenate(
        [np.column_stack([x, rows + down]) for x in (left, right) for down in (0, 1)]
    )
    flat = (corners - camera.matrix[:2, 2]) @ np.linalg.inv(camera.matrix[:2, :2]).T
    return np.asarray(flat)


def _cut(mask: Any) -> Floats:
    """Directions ``(K, 2)``, right and down, in which the object leaves the picture."""
    covered = mask >= COVERED
    sides = {(-1.0, 0.0): covered[:, 0], (1.0, 0.0): covered[:, -1]}
    sides |= {(0.0, -1.0): covered[0], (0.0, 1.0): covered[-1]}
    return np.array([way for way, side in sides.items() if side.any()]).reshape(-1, 2)


def _overlap(views: Views, names: list[str], votes: int, threads: int) -> float:
    """Mean over the masks of their intersection over union with the views' hull; 0 if none."""
    from .hull import VisualHull
    from .overlap import overlaps

    factor = max(1, round(max(views.masks.shape[1:]) / (4 * CELLS)))
    small = replace(views, normals=None).shrunk(factor)
    hull = VisualHull(small, names, votes, threads)
    try:
        vertices, triangles = hull.surface(hull.box(), CELLS)
    except InputError:
        return 0.0
    return float(overlaps(small, vertices, triangles).mean())
