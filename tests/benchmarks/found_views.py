"""The table of views as found: pictures of a shape are altered, as generators and people alter
them.

Run with ``make table-found-views``. The surface that classify makes of the altered pictures is
compared with that of the original ones. Distances are the 99th percentile in both directions,
divided by the longest side. First one surface is scaled and shifted to the other, because views
that are framed one by one do not determine that. A row is right if the distance is below LIMIT, and
said if a warning says that masks do not fit. It is refused if there is a sentence and exit code 3.
Otherwise it is silently wrong, and the command fails.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vorolight.stages.artifacts import hdf5
from vorolight.stages.inputs.views import coloured, six_views
from vorolight.stages.inputs.views.six_views import NAMES
from vorolight.stages.mesh.queries.projection import ClosestPoint
from vorolight.stages.render import drawing

LIMIT = 0.04
SAID = ("do not fit", "makes them agree", "make them agree")
ORDER = ("top", "back", "left", "front", "bottom", "right")

Pictures = list[np.ndarray]


def draw(mesh: Path, size: int, seed: int | None = None, own: bool = False) -> Pictures:
    """Six views with alpha: framed alike, framed at random, or each framed
    by its ``own`` extent."""
    loaded = coloured.load(mesh)
    used = np.unique(loaded.triangles)
    middle = 0.5 * (loaded.vertices[used].min(axis=0) + loaded.vertices[used].max(axis=0))
    vertices = loaded.vertices - middle
    vertices *= 0.575 / np.linalg.norm(vertices[used], axis=1).max()
    random = np.random.default_rng(seed)
    pictures = []
    for camera in six_views.cameras((size, size)):
        matrix = camera.matrix.copy()
        if own:
            pixels = camera.project(vertices[used])[:, :2]
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            scale = 0.9 * size / (high - low).max()
            shift = 0.5 * size - scale * 0.5 * (low + high)
            matrix[:2] = scale * matrix[:2]
            matrix[:2, 2] += shift
        elif seed is not None:
            scale = np.exp(random.uniform(-0.5, 0.0))
            matrix[:2, :2] *= scale
            matrix[:2, 2] += random.uniform(-0.5, 0.5, 2) * (1 - scale) * size
        rgba, _ = drawing.draw(
            vertices, loaded.triangles, loaded.colours, replace(camera, matrix=matrix), 2
        )
        pictures.append(np.rint(255 * rgba).astype(np.uint8))
    return pictures


def on(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    alpha = picture[..., 3:] / 255
    return np.rint(picture[..., :3] * alpha + np.array(colour) * (1 - alpha)).astype(np.uint8)


def opaque(pictures: Pictures, colour: tuple[int, int, int]) -> Pictures:
    return [on(picture, colour) for picture in pictures]


def cropped(picture: np.ndarray, room: int = 0) -> np.ndarray:
    rows, columns = (np.flatnonzero((picture[..., 3] > 127).any(axis=k)) for k in (1, 0))
    top, left = max(0, rows[0] - room), max(0, columns[0] - room)
    return picture[top : rows[-1] + 1 + room, left : columns[-1] + 1 + room]


def redrawn(picture: np.ndarray, random: np.random.Generator, amount: float) -> np.ndarray:
    """The picture with parts moved by up to ``amount`` of its width, as if a
    generator had drawn it again."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    height, width = picture.shape[:2]
    moves = [gaussian_filter(random.standard_normal((height, width)), width / 10) for _ in range(2)]
    moves = [amount * width * move / np.abs(move).max() for move in moves]
    row, column = np.mgrid[:height, :width]
    at = [row + moves[0], column + moves[1]]
    channels = [map_coordinates(picture[..., k].astype(float), at, order=1) for k in range(4)]
    return np.rint(np.stack(channels, axis=2)).astype(np.uint8)


def save(folder: Path, pictures: Pictures, names: Any = NAMES, ending: str = "png") -> None:
    folder.mkdir(parents=True)
    for name, picture in zip(names, pictures, strict=True):
        Image.fromarray(picture).save(folder / f"{name}.{ending}", quality=85)


def masks(folder: Path, pictures: Pictures, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for name, picture in zip(NAMES, pictures, strict=True):
        Image.fromarray(change(picture[..., 3] > 127)).save(folder / f"{name}_mask.png")


def cases(mesh: Path, folder: Path) -> dict[str, tuple[Path, list[str]]]:
    """For each name a folder of six pictures, and the options to run it with."""
    numbers = [f"image{k}" for k in range(6)]
    made: dict[str, tuple[Path, list[str]]] = {}

    def case(name: str, pictures: Pictures, *words: str, **how: Any) -> Path:
        place = folder / name.replace(" ", "-").replace(",", "")
        save(place, pictures, **how)
        made[name] = place, list(words)
        return place

    plain = draw(mesh, 256)
    random = np.random.default_rng(5)
    case("framed by themselves, 192 pixels", draw(mesh, 192, own=True))
    case("frames at random, 256 pixels", draw(mesh, 256, 1))
    case("frames at random, 512 pixels", draw(mesh, 512, 2))
    case("framed and redrawn by 1 %", [redrawn(p, random, 0.01) for p in draw(mesh, 256, own=True)])
    case("numbers, white, JPEG", opaque(draw(mesh, 256, 3), (255, 255, 255)), names=numbers,
         ending="jpg")  # fmt: skip
    case("black, sizes", opaque([cropped(p, 5 + 7 * k) for k, p in enumerate(plain)], (0, 0, 0)),
         "--background", "black")  # fmt: skip
    case("cropped, numbers from 1", [cropped(p) for p in draw(mesh, 256, own=True)],
         names=[f"{k:03d}" for k in range(1, 7)])  # fmt: skip
    case("green, names", opaque(draw(mesh, 256, 4), (0, 177, 64)),
         names=[f"rgb_000_{name}" for name in NAMES])  # fmt: skip
    turned = [plain[NAMES.index(name)] for name in ORDER]
    case("another order, said", turned, "--order", ",".join(ORDER), names=numbers)
    case("another order, not said", turned, names=numbers)
    speckled = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    case("no background", [*opaque(plain[:5], (255, 255, 255)), speckled])
    place = case("masks of 1 in 16 bits", opaque(plain, (90, 90, 90)))
    masks(place, plain, lambda covered: covered.astype(np.uint16))
    place = case("inverted masks, said", opaque(plain, (90, 90, 90)), "--invert-masks")
    masks(place, plain, lambda covered: 65535 * (~covered).astype(np.uint16))
    place = case("inverted masks, not said", opaque(plain, (90, 90, 90)))
    masks(place, plain, lambda covered: 255 * (~covered).astype(np.uint8))
    case("one view mirrored", [plain[0], np.ascontiguousarray(plain[1][:, ::-1]), *plain[2:]])
    return made


def call(*words: object) -> tuple[int, str]:
    command = [sys.executable, "-m", "vorolight.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.returncode, done.stderr


def surface(run: Path) -> tuple[np.ndarray, np.ndarray]:
    arrays, _ = hdf5.read(run / "classify.h5", "classify")
    return arrays["source/vertices"], arrays["source/triangles"]


def distance(
    found: tuple[np.ndarray, np.ndarray], expected: tuple[np.ndarray, np.ndarray]
) -> float:
    vertices, size = found[0], np.ptp(expected[0], axis=0).max()
    closest = ClosestPoint(*expected, 0.0, 1)
    # The start has the same size and centre; closest points then give scale and shift.
    vertices = vertices * (size / np.ptp(vertices, axis=0).max())
    vertices = vertices + expected[0].mean(axis=0) - vertices.mean(axis=0)
    for _ in range(30):
        target = closest(vertices)[0]
        a, b = vertices.mean(axis=0), target.mean(axis=0)
        scale = ((vertices - a) * (target - b)).sum() / ((vertices - a) ** 2).sum()
        vertices = b + scale * (vertices - a)
    there = np.linalg.norm(closest(vertices)[0] - vertices, axis=1)
    back = np.linalg.norm(
        ClosestPoint(vertices, found[1], 0.0, 1)(expected[0])[0] - expected[0], axis=1
    )
    return float(max(np.percentile(there, 99), np.percentile(back, 99)) / size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--only", default="", help="cases whose names hold this")
    given = parser.parse_args()
    wrong = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save(folder / "plain", draw(given.mesh, 256))

        def classified(place: Path, words: list[str]) -> tuple[int, str]:
            code, said = call(
                "from-image", given.mesh, "--six-views", place, "-o", f"{place}-views", *words
            )
            if code:
                return code, said
            code, more = call("classify", f"{place}-views", "-n", 10, "--run", f"{place}-run",
                              "--threads", 1)  # fmt: skip
            return code, said + more

        assert classified(folder / "plain", [])[0] == 0
        expected = surface(folder / "plain-run")
        print(
            "| views | result | p99 | masks, worst | largest scale | s |\n|---|---|---|---|---|---|"
        )
        for case, (place, words) in cases(given.mesh, folder / "cases").items():
            if given.only not in case:
                continue
            start = time.perf_counter()
            code, said = classified(place, words)
            seconds = f"{time.perf_counter() - start:.0f}"
            if code:
                (line,) = (line for line in said.splitlines() if line.startswith("vorolight:"))
                sentence = line.removeprefix("vorolight: ").replace(str(folder), "")
                print(f"| {case} | refused ({code}): {sentence} | | | | {seconds} |", flush=True)
                if code != 3:
                    wrong.append(case)
                continue
            told = json.loads(Path(f"{place}-run/classify.json").read_text())["metrics"]["input"]
            off = distance(surface(Path(f"{place}-run")), expected)
            result = "right" if off < LIMIT else "said" if any(s in said for s in SAID) else "wrong"
            if result == "wrong":
                wrong.append(case)
            scale = told["fit"]["largest_scale"] if told["fit"] else 1.0
            worst = told["mask_overlap_worst"]
            cells = [case, result, f"{off:.4f}", f"{worst:.3f}", f"{scale:.3f}", seconds]
            print("| " + " | ".join(cells) + " |", flush=True)
    if wrong:
        sys.exit(f"silently wrong: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
