"""Reads pictures, and encodes them as PNG and GIF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import BackendMissing, InputError

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

FRAME_MS = 70
"""Duration of a frame of an animation, in milliseconds."""
HEIF = (".heic", ".heif")
"""Suffixes of pictures that phones take, and that Pillow alone does not read."""


def read(path: Path, by_range: bool = False) -> NDArray[np.uint8]:
    """The picture at ``path``: ``(H, W)`` if grey, ``(H, W, 3)`` if RGB, ``(H, W, 4)`` if RGBA.

    Grey of 16 bits is scaled to 8 bits: from 65,535 or, with ``by_range``, from its largest value.
    Raises InputError if the file is missing or cannot be read, and BackendMissing if it is HEIC and
    the library for it is not installed.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with _open(path) as opened:
            opened.load()
            if opened.mode in ("1", "L"):
                mode = "L"
            elif opened.mode in ("I;16", "I;16B", "I"):  # grey pictures of 16 bits
                grey = np.asarray(opened).astype(np.int64)
                scaled = 255 * grey // max(1, int(grey.max())) if by_range else grey >> 8
                return np.asarray(scaled, dtype=np.uint8)
            else:
                mode = "RGBA" if opened.mode in ("RGBA", "LA", "PA", "RGBa") else "RGB"
                if opened.mode == "P" and "transparency" in opened.info:
                    mode = "RGBA"
            return np.asarray(opened.convert(mode))
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable picture ({reason[:80]})") from error
    except Image.DecompressionBombError as error:
        raise InputError(f"{path}: is too large a picture; scale it down") from error


def _open(path: Path) -> Picture:
    """The opened picture. Raises as ``read`` does."""
    from PIL import Image

    if not path.is_file():
        raise InputError(f"{path}: this picture is missing; restore it, or remove its view")
    if path.suffix.lower() in HEIF:
        try:
            # The wheels of pillow-heif contain an encoder under the GPL; these only decode.
            import pi_heif
        except ImportError:
            raise BackendMissing(
                f"{path}: HEIC pictures need a library that is not installed; run: pip "
                "install 'vorolight[images]'"
            ) from None
        pi_heif.register_heif_opener()
    return Image.open(path)


def size(path: Path) -> tuple[int, int]:
    """Width and height of the picture at ``path``, from its header. Raises as ``read`` does."""
    from PIL import UnidentifiedImageError

    try:
        with _open(path) as opened:
            return opened.size
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: not a readable picture") from error


def png(image: NDArray[np.float64]) -> bytes:
    """A PNG of 8 bits; ``image`` is ``(H, W)``, ``(H, W, 3)`` or ``(H, W, 4)``, from 0 to 1."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(_bytes(image)).save(out, "PNG", compress_level=6)
    return out.getvalue()


def gif(frames: Sequence[NDArray[np.float64]]) -> bytes:
    """An endlessly repeated animation of ``frames (H, W, 3)`` with values from 0 to 1."""
    from PIL import Image

    first, *others = (
        Image.fromarray(_bytes(frame)).quantize(256, dither=Image.Dither.NONE) for frame in frames
    )
    out = io.BytesIO()
    first.save(out, "GIF", save_all=True, append_images=others, duration=FRAME_MS, loop=0)
    return out.getvalue()


def _bytes(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
