"""A picture of a lamp with its light on, by path tracing (Mitsuba) or by rasterising."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import NumericalFailure
from ..mesh.polygons import Ints

AZIMUTH, ELEVATION = -60.0, 16.0
"""Direction from the object to the camera, in degrees."""
SIZE = 640
"""Width and height of the picture, in pixels."""
SAMPLES = 128
"""Light paths that are traced for each pixel."""
SECONDS = 1800
"""The time after which Mitsuba is stopped."""


def traced() -> bool:
    """Whether Mitsuba is installed."""
    from importlib.util import find_spec

    return find_spec("mitsuba") is not None


def rasterised(
    vertices: NDArray[np.float32], triangles: Ints, light: tuple[float, float, float] | None
) -> bytes:
    """A PNG that is made quickly, without Mitsuba or shadows. Arguments are as in ``png``."""
    from . import image_file, raster

    view = raster.view("z", AZIMUTH, ELEVATION)
    at = vertices.astype(np.float64)
    if light is None:
        image = raster.shaded(at, triangles, None, np.full(3, 0.92), view, SIZE, SIZE)
    else:
        image = raster.lit(at, triangles, light, view, SIZE, SIZE)
    return image_file.png(image)


def png(
    vertices: NDArray[np.float32],
    triangles: Ints,
    light: tuple[float, float, float] | None,
    threads: int,
    samples: int = SAMPLES,
    size: int = SIZE,
) -> bytes:
    """A path-traced PNG of an object that stands on the plane z = 0; its unit is the millimetre.

    With a ``light (3,)`` inside the object the room is dark; without one the object stands in
    daylight. Raises NumericalFailure if Mitsuba fails or takes longer than SECONDS.
    """
    from ..formats import ply
    from ..mesh.polygons import PolygonMesh

    with tempfile.TemporaryDirectory() as folder:
        mesh, target = Path(folder) / "object.ply", Path(folder) / "object.png"
        mesh.write_bytes(
            ply.encode(PolygonMesh.of_triangles(vertices.astype(np.float64), triangles))
        )
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        asked = {
            "mesh": str(mesh), "target": str(target), "light": light, "threads": threads,
            "low": low.tolist(), "high": high.tolist(), "samples": samples, "size": size,
            "azimuth": AZIMUTH, "elevation": ELEVATION,
        }  # fmt: skip
        try:
            done = subprocess.run(
                [sys.executable, "-m", "vorolight.stages.render.lit_child", json.dumps(asked)],
                capture_output=True, text=True, errors="replace", timeout=SECONDS,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise NumericalFailure(
                f"--render: Mitsuba did not end within {SECONDS // 60} minutes; leave it out"
            ) from None
        if done.returncode or not target.exists():
            said = (done.stderr.strip().splitlines() or ["no output"])[-1][:200]
            raise NumericalFailure(
                f"--render: Mitsuba ended with {done.returncode} ({said}); leave it out"
            )
        return target.read_bytes()
