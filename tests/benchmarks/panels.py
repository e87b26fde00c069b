"""Pictures of runs as panels of equal size, and grids of panels with captions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine.freshness import recorded_input
from vorolight.stages.inputs.resolve import up_axis
from vorolight.stages.mesh.geometry import fan_triangles
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.render import image_file, raster
from vorolight.stages.report import pictures, preview

CAPTION = 22
"""Height of a line of text, in pixels."""


def surface(
    run: Path, stage: str, size: int, prefix: str = "surface/", shape: Path | None = None
) -> np.ndarray:
    """The surface of a stage with its edges, ``(size, size, 3)``.

    It is upright like ``shape``, by default like the input.
    """
    folder = RunFolder(run)
    vertices, triangles, faces = fan_triangles(
        PolygonMesh.from_arrays(folder.arrays(stage, stage), prefix)
    )
    return raster.shaded(
        vertices, triangles, faces, pictures.SURFACE, view(folder, shape), size, size
    )


def view(folder: RunFolder, shape: Path | None) -> raster.View:
    """The view that the report uses."""
    stored = folder.manifest("classify")
    assert stored is not None
    up = up_axis(stored["inputs"][0]["path"] if shape is None else str(shape))
    return raster.view(up, pictures.AZIMUTH[up])


def cut(run: Path, size: int) -> np.ndarray:
    """The cells of the volume, cut open."""
    drawn = pictures.cutaway(RunFolder(run), size)
    assert drawn is not None
    return drawn


def field_slice(run: Path, size: int) -> np.ndarray:
    """The middle slice through the input and its voxels."""
    folder = RunFolder(run)
    source = recorded_input(folder)
    assert source is not None
    classified = folder.arrays("classify", "classify")
    return preview.preview(source.open(classified), classified, size)[:, -size:]


def empty(size: int) -> np.ndarray:
    """An empty panel for a run that failed."""
    return np.full((size, size, 3), 0.93)


def grid(
    rows: Sequence[Sequence[np.ndarray]], columns: Sequence[str], labels: Sequence[str]
) -> np.ndarray:
    """Panels in rows, with ``columns`` above them and ``labels`` over each row."""
    size = rows[0][0].shape[1]
    width = size * max(len(row) for row in rows)
    parts = [words(list(columns), size, width)] if columns else []
    for label, row in zip(labels, rows, strict=True):
        parts += [words([label], width, width)] if label else []
        parts.append(np.concatenate(row, axis=1))
    return np.concatenate(parts)


def words(texts: list[str], step: int, width: int) -> np.ndarray:
    """A line of texts, one every ``step`` pixels."""
    image = Image.new("RGB", (width, CAPTION), "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    for k, text in enumerate(texts):
        draw.text((k * step + 6, 3), text, fill=(40, 44, 56), font=font)
    return np.asarray(image) / 255


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(image_file.png(image))
