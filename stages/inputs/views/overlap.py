"""How well masks and a surface agree."""

from __future__ import annotations

import numpy as np

from ...mesh.polygons import Floats, Ints
from ...render.cameras import visible
from ...render.views import COVERED, Views


def overlaps(views: Views, vertices: Floats, triangles: Ints) -> Floats:
    """Intersection over union of masks and what the cameras see of a closed surface ``(N,)``."""
    shares = []
    for camera, mask in zip(views.cameras, views.masks, strict=True):
        seen = visible(camera, camera.project(vertices), triangles) >= 0
        covered = mask >= COVERED
        shares.append((seen & covered).sum() / (seen | covered).sum())
    return np.array(shares)
