"""Write the cells of a run to a file or folder that the user chooses."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..artifacts import atomic
from ..artifacts.run_folder import RunFolder
from ..errors import InputError, UsageError
from ..formats.registry import FORMATS, Format, Volume
from ..mesh.polygons import Floats
from ..mesh.polyhedra import PolyhedralMesh
from ..metrics.polyhedra import cell_data, quality

_CUT = re.compile(r"^\s*([xyz])\s*([=<>])\s*([-+.0-9eE]+)\s*$")


def format_of(target: Path, name: str | None) -> Format:
    """The format ``name``, or that of the target's suffix. Raises UsageError if there is none."""
    if name is not None:
        if name not in FORMATS:
            raise UsageError(f"--format {name}: must be one of {', '.join(FORMATS)}")
        return FORMATS[name]
    suffix = target.suffix.lower().lstrip(".")
    for form in FORMATS.values():
        if form.suffix == suffix and suffix:
            return form
    known = ", ".join(sorted({f".{form.suffix}" for form in FORMATS.values() if form.suffix}))
    raise UsageError(
        f"{target}: no format has that suffix ({known}); name one with "
        f"--format [{'|'.join(FORMATS)}]"
    )


def _kept(cut: str, points: Floats) -> NDArray[np.bool_]:
    """The cells on one side, by their ``points (C, 3)``."""
    match = _CUT.match(cut)
    try:
        at = float(match.group(3)) if match else np.nan
    except ValueError:
        at = np.nan
    if match is None or not np.isfinite(at):
        raise UsageError(f"--cut {cut}: must be like x=0.1 (cells below) or x>0.1 (cells above)")
    along = points[:, "xyz".index(match.group(1))]
    keep = along > at if match.group(2) == ">" else along < at
    if not keep.any():
        raise InputError(
            f"--cut {cut}: no cell lies there; {match.group(1)} goes from {along.min():.4g} to "
            f"{along.max():.4g}"
        )
    return np.asarray(keep)


def export(folder: RunFolder, target: Path, form: Format, cut: str | None, force: bool) -> str:
    """Write the cells of ``folder`` to ``target``, and return what was written in a few words.

    Raises UsageError if something exists there, unless ``force``, and InputError for a cut without
    cells. Nothing is left half-written.
    """
    if form.suffix and target.is_dir():
        raise UsageError(f"{target}: is a folder; name a file")
    if not form.suffix and target.is_file():
        raise UsageError(f"{target}: is a file; name a folder")
    held = target if form.suffix else target / form.inside
    there = held.exists() and (form.suffix or form.inside or any(held.iterdir()))
    if there and not force:
        raise UsageError(f"{held}: exists; choose another name, or replace it with --force")
    arrays = folder.arrays("volume", "volume")
    mesh = PolyhedralMesh.from_arrays(arrays)
    points, volume = arrays["generators"][mesh.cell_generator], arrays["cell_volume"]
    role = arrays["generator_role"][mesh.cell_generator]
    data = cell_data(mesh, role, volume, quality(mesh))
    if cut is not None:
        keep = _kept(cut, points)
        mesh, points = mesh.select_cells(keep), points[keep]
        data = {name: values[keep] for name, values in data.items()}
    cells = Volume(mesh, data, points)
    files = form.encode(cells)
    atomic.make_folder(target.parent if form.suffix else target)
    if form.inside:
        _write_case(target, files, form.inside)
    else:
        for path, content in files.items():
            atomic.write(target / path if path else target, content)
    said = f"{mesh.cell_count} cells, {mesh.faces.face_count} faces"
    return said if form.remark is None else f"{said}; {form.remark(cells)}"


def _write_case(target: Path, files: dict[str, bytes], inside: str) -> None:
    """Write a case: its mesh is there as a whole or not at all, and existing settings stay."""
    mesh = f"{inside}/"
    for path, content in files.items():
        if not path.startswith(mesh) and not (target / path).exists():
            atomic.make_folder((target / path).parent)
            atomic.write(target / path, content)
    place = target / inside
    fresh = place.with_name(f".{place.name}.tmp.{os.getpid()}")
    former = place.with_name(f".{place.name}.old.{os.getpid()}")
    atomic.make_folder(fresh)
    try:
        for path, content in files.items():
            if path.startswith(mesh):
                atomic.write(fresh / path[len(mesh) :], content)
        if place.exists():
            atomic.move(place, former)
        atomic.move(fresh, place)
        shutil.rmtree(former, ignore_errors=True)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
