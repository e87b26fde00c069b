"""Time of one step of the image losses with their derivatives, beside Mitsuba 3.

Run with ``make bench-images``. Mitsuba renders the depth of the same views with one ray for each
pixel. That is visibility alone, without derivatives.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from vorolight.stages.inputs.views.writer import around
from vorolight.stages.render.views import Views
from vorolight.stages.training.losses.images import Silhouettes

VIEWS, SIZE, REPEATS = 16, 256, 7


def median(step: Callable[[], object]) -> float:
    step()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=100, minor_sections=50)
    vertices, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    cameras = around(np.zeros(3), 1.4, VIEWS, SIZE, False, 0)
    masks = np.zeros((VIEWS, SIZE, SIZE), np.uint8)
    normals = np.full((VIEWS, SIZE, SIZE, 3), 18918, np.int16)
    compare = Silhouettes(Views(tuple(cameras), masks, normals), 2)
    own = median(lambda: compare(vertices, triangles, np.arange(VIEWS)))
    print(f"{VIEWS} views of {SIZE} x {SIZE}, {len(triangles)} triangles, two threads")
    print(f"losses and derivatives {own:.3f} s")
    import mitsuba

    mitsuba.set_variant("scalar_rgb")  # other variants need an installation of LLVM
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        mesh.export(path)
        shape = {"type": "ply", "filename": str(path)}
        sensors = []
        for camera in cameras:
            outer = np.eye(4)
            outer[:3, :3] = camera.rotation.T * [-1.0, -1.0, 1.0]
            outer[:3, 3] = camera.position
            angle = np.degrees(2 * np.arctan(0.5 * SIZE / camera.matrix[0, 0]))
            sensors.append(
                mitsuba.load_dict(
                    {
                        "type": "perspective",
                        "fov": float(angle),
                        "to_world": mitsuba.ScalarTransform4f(outer),
                        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE,
                                 "rfilter": {"type": "box"}},
                        "sampler": {"type": "independent", "sample_count": 1},
                    }
                )
            )  # fmt: skip
        scene = mitsuba.load_dict(
            {"type": "scene", "integrator": {"type": "aov", "aovs": "d:depth"}, "mesh": shape}
        )
        other = median(lambda: [np.array(mitsuba.render(scene, sensor=s)) for s in sensors])
    print(f"Mitsuba 3 ({mitsuba.variant()}), depth alone {other:.3f} s: {other / own:.1f} times")


if __name__ == "__main__":
    main()
