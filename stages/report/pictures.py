"""Pictures of a run, drawn from its files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..artifacts.run_folder import RunFolder
from ..inputs.resolve import recorded_up
from ..mesh.geometry import fan_triangles
from ..mesh.polygons import Floats, Ints, PolygonMesh
from ..render import image_file, lit, raster

SURFACE = np.array([0.56, 0.72, 0.88])
INNER = np.array([0.98, 0.75, 0.42])
PRINT = np.array([0.93, 0.90, 0.84])
AZIMUTH = {"y": 60.0, "z": -60.0}


def up_of(folder: RunFolder) -> str:
    """The axis, y or z, that is drawn upward."""
    return recorded_up(folder.manifest("classify"))


def _view(up: str) -> raster.View:
    return raster.view(up, AZIMUTH[up])


def surfaces(folder: RunFolder, size: int = 480) -> Floats | None:
    """Initial surface, trained polygons and written surface side by side, as far as done."""
    panels = []
    for stage, prefix in (
        ("init", "surface/"), ("sphere-train", "trained/"), ("sphere-train", "surface/")
    ):  # fmt: skip
        if folder.manifest(stage) is None:
            continue
        mesh = PolygonMesh.from_arrays(folder.arrays(stage, stage), prefix)
        vertices, triangles, faces = fan_triangles(mesh)
        view = _view(up_of(folder))
        panels.append(raster.shaded(vertices, triangles, faces, SURFACE, view, size, size))
    return np.concatenate(panels, axis=1) if panels else None


def cut_open(folder: RunFolder) -> tuple[PolygonMesh, NDArray[np.bool_], Ints, NDArray[np.bool_]]:
    """The cells of the volume behind a plane through its middle: their outer faces, which of them
    are turned inward, the cell of each, and whether that is an inner one."""
    arrays = folder.arrays("volume", "volume")
    up = up_of(folder)
    generator = arrays["generators"][arrays["cell_generator"]]
    inner = arrays["generator_role"][arrays["cell_generator"]] == 2
    across = _view(up).frame()[2].copy()
    across["xyz".index(up)] = 0.0
    depth = generator @ across
    kept = depth < np.median(depth)
    owner, neighbour = arrays["face_owner"], arrays["face_neighbour"]
    beyond = (neighbour >= 0) & kept[neighbour]
    shown = kept[owner] != beyond
    flip = ~kept[owner[shown]]
    cell = np.where(flip, neighbour[shown], owner[shown])
    return PolygonMesh.from_arrays(arrays).select_faces(shown), flip, cell, inner[cell]


def cutaway(folder: RunFolder, size: int = 480) -> Floats | None:
    """The cut volume; inner cells in another colour."""
    if folder.manifest("volume") is None:
        return None
    mesh, flip, cell, inner = cut_open(folder)
    vertices, triangles, faces = fan_triangles(mesh)
    triangles = np.where(flip[faces, None], triangles[:, ::-1], triangles)
    colors = np.where(inner[faces, None], INNER, SURFACE)
    # Outlined are cells, not faces.
    return raster.shaded(vertices, triangles, cell[faces], colors, _view(up_of(folder)), size, size)


def printed(folder: RunFolder) -> tuple[Floats, Ints]:
    """Vertices in mm and triangles of the object that fabricate wrote.

    Raises ArtifactError when its file is not the one that was written.
    """
    from ..formats import ply

    mesh = ply.decode(folder.output("fabricate", "ply"))
    assert mesh is not None
    return mesh.vertices, mesh.face_vertices.reshape(-1, 3)


def _picture(folder: RunFolder, stage: str, role: str) -> NDArray[np.uint8]:
    """A picture that a stage wrote, if it was not changed since."""
    folder.output(stage, role)
    return image_file.read(folder.file(stage, role))


def lamp(folder: RunFolder, size: int = 640) -> Floats | None:
    """The printable object: at night with its light on, path traced if asked for, and by day."""
    stored = folder.manifest("fabricate")
    if stored is None:
        return None
    vertices, triangles = printed(folder)
    # As the path tracer sees it; whatever was up in the input is z here.
    view = raster.view("z", lit.AZIMUTH, lit.ELEVATION)
    day = raster.shaded(vertices, triangles, None, PRINT, view, size, size)
    if any(entry["role"] == "png" for entry in stored["outputs"]):
        night = _picture(folder, "fabricate", "png")[..., :3] / 255
        return np.concatenate([night, day], axis=1)
    light = stored["metrics"].get("light")
    if light is None:
        return day
    low, high = light["cup_height_mm"], float(vertices[:, 2].max())
    source = (light["x_mm"], light["y_mm"], low + 0.2 * (high - low))
    night = raster.lit(vertices, triangles, source, view, size, size)
    return np.concatenate([night, day], axis=1)


def appearance(folder: RunFolder) -> Floats | None:
    """Four pictures of the orbit that stage shade drew, if it did."""
    stored = folder.manifest("shade")
    outputs = stored["outputs"] if stored else []
    roles = [entry["role"] for entry in outputs if entry["role"].startswith("orbit-")]
    if not roles:
        return None
    shown = [roles[k * len(roles) // 4] for k in range(min(4, len(roles)))]
    return np.concatenate([_picture(folder, "shade", role) / 255 for role in shown], axis=1)


PICTURES = {"surfaces": surfaces, "appearance": appearance, "cutaway": cutaway, "lamp": lamp}
