"""Stage shade: learn the colours of the surface from the views.

Example:
    >>> from vorolight.stages import shade
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "shade", shade.Params(render="orbit"))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from . import torch_start
from .engine.params import Positive, Range, StageParams
from .engine.stage import Context, Outcome, Stage
from .errors import UsageError
from .memory import peak

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import torch
    from numpy.typing import NDArray

    from .inputs.views.source import ViewSource
    from .mesh.polygons import Floats, Ints, PolygonMesh
    from .render.cameras import Camera
    from .render.shader import Shader

SHARE, MOST = 0.75, 8_000
"""Share of the valid pixels of a view that a step uses, and their largest number."""
CHECKPOINT_EVERY = 20
ELEVATION = 15.0
"""Elevation of the cameras of an orbit, in degrees."""
SAMPLES = 2
"""Number of rays for each pixel, along each side."""
WORTH_SAYING = 0.01
"""Share of the surface from which on a warning is given."""


@dataclass(frozen=True)
class Params(StageParams):
    """Options of the shade stage."""

    iterations: Annotated[int, Range(0, 1_000_000)] = 2000
    """Number of Adam steps, each on one view."""
    learning_rate: Positive = 1e-3
    """First step of Adam. It falls to 0 along a cosine."""
    width: Annotated[int, Range(8, 1024)] = 128
    """Number of neurons in a layer."""
    held_out: Annotated[int, Range(0, 10_000)] | None = None
    """Number of views that are only used to measure the result. Default: an eighth of them, at most
    8, and none if there are six views."""
    render: Literal["none", "orbit"] = "none"
    """orbit draws pictures from all around the object (PNG) and an animation (GIF)."""
    frames: Annotated[int, Range(2, 1000)] = 36
    """Number of pictures of the orbit."""
    size: Annotated[int, Range(16, 4096)] = 384
    """Pixels along a side of the orbit's pictures."""


@dataclass(frozen=True)
class Geometry:
    """The written surface as triangles, with smooth normals."""

    vertices: Floats
    triangles: Ints
    normals: Floats

    def seen(self, camera: Camera) -> tuple[Ints, Ints, Floats, Floats, Floats]:
        """Rows, columns, points, unit normals and unit rays of the pixels in which ``camera`` sees
        the surface."""
        import numpy as np

        from .render.drawing import fragments

        hit = fragments(self.vertices, self.triangles, camera, both=False)
        corner = self.triangles[hit.triangle]
        point, normal = (
            np.einsum("ni,nij->nj", hit.weights, values[corner])
            for values in (self.vertices, self.normals)
        )
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        rays = camera.rays(np.column_stack([hit.columns, hit.rows]).astype(np.float64) + 0.5)
        return hit.rows, hit.columns, point, normal, rays

    def unseen(self, cameras: Sequence[Camera]) -> float:
        """Share of the surface, by area, that none of ``cameras`` sees."""
        import numpy as np

        from .mesh.geometry import triangle_areas
        from .render.cameras import visible

        found = np.zeros(len(self.vertices), dtype=bool)
        for camera in cameras:
            seen = visible(camera, camera.project(self.vertices), self.triangles)
            found[self.triangles[np.unique(seen[seen >= 0])]] = True
        # A triangle smaller than a pixel counts as seen if its neighbour is.
        area = triangle_areas(self.vertices, self.triangles)
        return float(area[~found[self.triangles].any(axis=1)].sum() / area.sum())


def run(context: Context) -> Outcome:
    """Train the shader, on one view in each step (paper's appendix A.1, L_shading)."""
    import numpy as np
    import torch

    from .inputs.views.source import ViewSource
    from .mesh.geometry import fan_triangles, vertex_normals
    from .mesh.polygons import PolygonMesh
    from .render.shader import Shader, layers, shade
    from .solvers.adam import Schedule, adam

    torch_start.start(context.threads)
    params, source = context.params, context.source()
    if not isinstance(source, ViewSource):
        raise UsageError(f"shade: the input is of kind {source.kind}, and only views have colours")
    source.threads = context.threads
    mesh = PolygonMesh.from_arrays(context.arrays("sphere-train"), "surface/")
    vertices, triangles, _ = fan_triangles(mesh)
    geometry = Geometry(vertices, triangles, vertex_normals(vertices, triangles))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    weights = layers(params.width, context.random("weights"))
    for tensor in weights.values():
        tensor.requires_grad_(True)
    shader = Shader(weights, 0.5 * (low + high), 0.5 * float((high - low).max()))
    trained, held = split(len(source.names), params.held_out)
    pixels = Pixels(source, geometry)
    order: list[int] = []

    def losses(iteration: int) -> dict[str, torch.Tensor]:
        turn, place = divmod(iteration, len(trained))
        if place == 0 or not order:
            order[:] = trained[context.random("order", turn).permutation(len(trained))].tolist()
        point, normal, ray, colour = pixels.of(order[place])
        count = max(1, min(MOST, int(SHARE * len(point))))
        chosen = context.random("pixels", iteration).permutation(len(point))[:count]
        found = shade(
            weights,
            shader.placed(point[chosen]),
            torch.from_numpy(normal[chosen].astype(np.float32)),
            torch.from_numpy(ray[chosen].astype(np.float32)),
        )
        target = torch.from_numpy(colour[chosen])
        return {"shading": torch.nn.functional.smooth_l1_loss(found, target)}

    history = adam(
        weights,
        losses,
        {"shading": 1.0},
        Schedule(params.iterations, params.learning_rate, "cosine", CHECKPOINT_EVERY),
        context.checkpoints,
        context.progress,
        "shade",
    )
    final = {name: tensor.detach().numpy() for name, tensor in weights.items()}
    shader = Shader(final, shader.centre, shader.size)
    scores = {int(view): psnr(shader, pixels, int(view)) for view in held}
    files = baked(mesh, geometry, shader)
    if params.render == "orbit":
        files |= orbit(source, geometry, shader, params.frames, params.size)
    unseen = geometry.unseen([source.views.cameras[view] for view in trained])
    warnings = []
    if unseen > WORTH_SAYING:
        warnings.append(
            f"no picture shows {100 * unseen:.0f} % of the surface, so its colours there are "
            "guesses"
        )
    worst = sorted(scores.items(), key=lambda item: item[1])[:3]
    return Outcome(
        arrays={
            **{f"shader/{name}": values for name, values in final.items()},
            "shader/centre": shader.centre,
            "shader/size": np.array(shader.size),
            "history": history,
        },
        files=files,
        metrics={
            "trained_views": len(trained),
            "held_out_views": [source.names[view] for view in held],
            "held_out_psnr": float(np.mean(list(scores.values()))) if scores else None,
            "held_out_psnr_worst": {source.names[view]: score for view, score in worst},
            "held_out_seen": float(np.mean([pixels.share(int(view)) for view in held]))
            if len(held)
            else None,
            "unseen_share": unseen,
            "final_loss": float(history[-1, 0]) if len(history) else None,
        },
        warnings=warnings,
    )


def split(count: int, held_out: int | None) -> tuple[Ints, Ints]:
    """Numbers of the views to train on, and of the other views, spread evenly.

    Raises UsageError if no view would be left to train on.
    """
    import numpy as np

    if held_out is None:
        held_out = min(8, count // 8)
    if held_out >= count:
        raise UsageError(
            f"--held-out {held_out}: there are only {count} views, and some must remain for "
            "training; lower it"
        )
    held = np.floor((np.arange(held_out) + 0.5) * count / max(1, held_out)).astype(np.int64)
    return np.setdiff1d(np.arange(count), held), held


class Pixels:
    """The pixels of a surface in the views, one view at a time; small sets are kept in memory."""

    MOST = 6_000_000

    def __init__(self, source: ViewSource, geometry: Geometry) -> None:
        self.source, self.geometry = source, geometry
        self.kept: dict[int, tuple[Floats, Floats, Floats, NDArray[np.float32]]] = {}
        self.count = 0

    def of(self, view: int) -> tuple[Floats, Floats, Floats, NDArray[np.float32]]:
        """Points, normals, rays and colours ``(N, 3)`` of the pixels that the mask and the surface
        cover."""
        from .inputs.views.pictures import colours
        from .render.views import COVERED

        if view in self.kept:
            return self.kept[view]
        camera = self.source.views.cameras[view]
        rows, columns, point, normal, ray = self.geometry.seen(camera)
        good = self.source.views.masks[view][rows, columns] >= COVERED
        picture = colours(self.source.found.shots[view])
        found = point[good], normal[good], ray[good], picture[rows[good], columns[good]]
        if self.count + len(found[0]) <= self.MOST:
            self.count += len(found[0])
            self.kept[view] = found
        return found

    def share(self, view: int) -> float:
        """Which pixels of a mask the surface covers."""
        from .render.views import COVERED

        return len(self.of(view)[0]) / int((self.source.views.masks[view] >= COVERED).sum())


def psnr(shader: Shader, pixels: Pixels, view: int) -> float:
    """Peak signal-to-noise ratio in dB over the pixels of ``view`` that mask and surface cover."""
    import numpy as np

    point, normal, ray, colour = pixels.of(view)
    error = float(((shader(point, normal, ray) - colour) ** 2).mean())
    return float(-10 * np.log10(max(error, 1e-12)))


def baked(mesh: PolygonMesh, geometry: Geometry, shader: Shader) -> dict[str, bytes]:
    """The surface with colours at its vertices, seen along the normal: polygons as PLY, triangles
    as GLB."""
    import numpy as np

    from .formats import glb, ply

    colour = np.rint(255 * shader(geometry.vertices, geometry.normals, -geometry.normals))
    colour = colour.astype(np.uint8)
    return {
        "ply": ply.encode(mesh, colours=colour[: mesh.vertex_count]),
        "glb": glb.encode(geometry.vertices, geometry.triangles, colour),
    }


def orbit(
    source: ViewSource, geometry: Geometry, shader: Shader, frames: int, size: int
) -> dict[str, bytes]:
    """Pictures from all around the object; the axis is the mean upward direction of the cameras."""
    import numpy as np

    from .render import image_file
    from .render.cameras import looking

    up = -np.mean([camera.rotation[1] for camera in source.views.cameras], axis=0)
    # Cameras that are turned in all directions have no mean upward direction.
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.3 else np.array([0.0, 0.0, 1.0])
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    low, high = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    focal = 0.5 * SAMPLES * size * np.sqrt(8.0)
    centre = 0.5 * SAMPLES * size
    matrix = np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1.0]])
    rise = np.radians(ELEVATION)
    pictures: list[Any] = []
    for turn in 2 * np.pi * np.arange(frames) / frames:
        side = np.cos(rise) * (np.cos(turn) * first + np.sin(turn) * second) + np.sin(rise) * up
        camera = looking(middle + 3 * radius * side, middle, up, matrix, SAMPLES * size, False)
        rows, columns, point, normal, ray = geometry.seen(camera)
        image = np.ones((SAMPLES * size, SAMPLES * size, 3))
        image[rows, columns] = shader(point, normal, ray)
        pictures.append(image.reshape(size, SAMPLES, size, SAMPLES, 3).mean(axis=(1, 3)))
    digits = len(str(frames - 1))
    files = {
        f"orbit-{number:0{digits}d}.png": image_file.png(picture)
        for number, picture in enumerate(pictures)
    }
    return {**files, "gif": image_file.gif(pictures)}


def _memory(context: Context) -> float:
    faces = float(len(context.arrays("sphere-train")["surface/face_offsets"]))
    return peak(1000.0, 900.0, 3.0, faces)


STAGE = Stage(
    name="shade",
    version=1,
    params=Params,
    run=run,
    parents=lambda params: ("classify", "sphere-train"),
    reads_input=True,
    memory=_memory,
)
