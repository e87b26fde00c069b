"""NIfTI: the samples of one volume, read with nibabel."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from . import packed
from .sample_grid import Samples, count_of, placed

SECOND = 540
"""Size of a NIfTI-2 header in bytes. Such a header begins with this number."""
PLACELESS = (
    "the file does not say how its samples lie in space: their axes are taken for x, y and z, from "
    "the origin on"
)


def read(path: Path) -> Samples:
    """The samples in NIfTI's coordinates: x to the right, y to the front, z up.

    Raises InputError if a gzip file is damaged, and ValueError if the file is not one volume.
    """
    import nibabel

    raw = packed.content(path)
    # nibabel logs every repair of a header.
    nibabel.imageglobals.logger.setLevel(logging.CRITICAL)
    second = raw[:4] in (SECOND.to_bytes(4, "little"), SECOND.to_bytes(4, "big"))
    kind = nibabel.Nifti2Image if second else nibabel.Nifti1Image
    notes: tuple[str, ...] = ()
    try:
        image = kind.from_bytes(raw)
        shape = image.shape
        while len(shape) > 3 and shape[-1] == 1:
            shape = shape[:-1]
        if len(shape) > 3:
            raise ValueError(f"it holds volumes of shape {shape}; save one of them")
        count_of(shape)
        values = np.asanyarray(image.dataobj).reshape(shape)
        affine = np.asarray(image.affine, dtype=np.float64)
        if not (image.header["sform_code"] or image.header["qform_code"]):
            # nibabel mirrors x here, which the format does not require.
            spacing = np.abs(np.asarray(image.header["pixdim"][1:4], dtype=np.float64))
            affine, notes = np.diag([*spacing.tolist(), 1.0]), (PLACELESS,)
    # On damaged files, nibabel raises exceptions of any kind.
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error
    if values.dtype.kind not in "fiub":
        raise ValueError(f"its samples are {values.dtype}, not numbers")
    return placed(values, affine[:3, 3], affine[:3, :3], notes)
