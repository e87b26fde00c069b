"""The lit halves of the lamps' pictures, side by side: ``gallery.py OUTPUT PICTURE...``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from vorolight.stages.render import image_file


def main(output: Path, *pictures: Path) -> None:
    halves = []
    for picture in pictures:
        image = image_file.read(picture)[..., :3] / 255
        lit = image[:, : image.shape[1] // 2]
        # Half the size: the mean of two by two pixels also halves the noise of the path tracer.
        halves.append((lit[::2, ::2] + lit[1::2, ::2] + lit[::2, 1::2] + lit[1::2, 1::2]) / 4)
    output.write_bytes(image_file.png(np.concatenate(halves, axis=1)))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
