"""The child process of ``lit``: Mitsuba may end the process that loads it."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

FIELD_OF_VIEW = 30.0
"""Of the camera, in degrees."""


def scene(asked: dict[str, Any]) -> dict[str, Any]:
    """Mitsuba's scene: a plastic object on a table, with a warm light in it or a bright sky."""
    import mitsuba as mi

    low, high = np.array(asked["low"]), np.array(asked["high"])
    middle = 0.5 * (low + high)
    reach = 0.5 * float(np.linalg.norm(high - low))
    turn, rise = np.radians([asked["azimuth"], asked["elevation"]])
    towards = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    # The camera is so far away that all corners of the bounding box are in the picture.
    across = np.cross([0.0, 0.0, 1.0], towards) / np.cos(rise)
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3) - middle
    beside = np.abs(corners @ np.stack([across, np.cross(towards, across)], axis=1))
    tangent = 0.98 * np.tan(np.radians(FIELD_OF_VIEW / 2))
    eye = middle + towards * float((beside.max(axis=1) / tangent + corners @ towards).max())
    found: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": {
            "type": "perspective",
            "fov": FIELD_OF_VIEW,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=eye.tolist(), target=middle.tolist(), up=[0, 0, 1]
            ),
            "sampler": {"type": "multijitter", "sample_count": asked["samples"]},
            "film": {
                "type": "hdrfilm",
                "width": asked["size"],
                "height": asked["size"],
                "rfilter": {"type": "gaussian"},
            },
        },
        "object": {
            "type": "ply",
            "filename": asked["mesh"],
            "face_normals": True,
            # The plastic lets some light through. A plate has two sides, so that it lets a quarter
            # of this through.
            "bsdf": {
                "type": "principledthin",
                "base_color": {"type": "rgb", "value": [0.86, 0.84, 0.8]},
                "roughness": 0.6,
                "diff_trans": 0.4,
            },
        },
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, float(low[2]) - 0.05])
            @ mi.ScalarTransform4f().scale(400 * reach),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.36, 0.33]}},
        },
    }
    night = asked["light"] is not None
    sky = [0.012, 0.014, 0.022] if night else [0.9, 0.92, 1.0]
    found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": sky}}
    if night:
        radius = 0.05 * reach
        strength = 60.0 * (reach / (20 * radius)) ** 2
        found["light"] = {
            "type": "sphere",
            "center": list(asked["light"]),
            "radius": radius,
            "emitter": {
                "type": "area",
                "radiance": {
                    "type": "rgb", "value": [strength * c for c in (1.0, 0.62, 0.28)],
                },
            },
        }  # fmt: skip
    return found


def main() -> None:
    """Draw the picture that the first argument describes as JSON."""
    import drjit
    import mitsuba as mi

    asked = json.loads(sys.argv[1])
    drjit.set_thread_count(asked["threads"])
    mi.set_variant("scalar_rgb")
    image = mi.render(mi.load_dict(scene(asked)))
    write: Any = mi.util.write_bitmap
    write(asked["target"], image)


if __name__ == "__main__":
    main()
