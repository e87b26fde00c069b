"""From what the user typed, or a manifest recorded, to a source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..artifacts import fingerprint
from ..errors import InputError
from ..formats import packed

if TYPE_CHECKING:
    from .source import Source


KINDS = ("mesh", "points", "field", "views")
Y_UP = (".obj", ".ply", ".off", ".glb", ".gltf")
PLY_HEADER = 65536
"""Bytes of a PLY that tell whether it has faces."""


def up_axis(path: str | None) -> str:
    """The axis that points up in an input: y for formats that mostly have it so, else z."""
    return "y" if path is not None and packed.ending(Path(path)) in Y_UP else "z"


def recorded_up(manifest: Mapping[str, Any] | None) -> str:
    """The axis that points up in the input of a run, by its ``manifest`` of classify."""
    if not manifest:
        return "z"
    told = manifest["metrics"]["input"].get("up")  # of views, by their cameras
    return str(told) if told in ("y", "z") else up_axis(manifest["inputs"][0]["path"])


@dataclass(frozen=True)
class Identity:
    """An input without opening it: what a fingerprint and a manifest need."""

    kind: str
    name: str
    path: Path | None
    bytes: int | None
    sha256: str | None
    allow_code: bool = False
    """Whether a field that is Python code may be run."""

    @property
    def stem(self) -> str:
        """What the run folder is called after."""
        return self.name if self.path is not None or self.built_in else "formula"

    @property
    def built_in(self) -> bool:
        """Whether it is one of the named fields."""
        from .field.source import FIELDS

        return self.path is None and self.name in FIELDS

    def open(self, stored: Mapping[str, Any] | None = None) -> Source:
        """The source; ``stored`` are the arrays of stage classify, if it has been prepared there.

        Raises InputError when the file cannot be used.
        """
        from .field.source import FieldSource
        from .mesh.source import MeshSource
        from .points.source import PointSource

        source: Source
        if self.kind == "field":
            source = FieldSource(self.name, path=self.path, allow_code=self.allow_code)
        elif self.kind == "views":
            from .views.source import ViewSource

            assert self.path is not None
            source = ViewSource(self.path)
        else:
            assert self.path is not None
            source = MeshSource(self.path) if self.kind == "mesh" else PointSource(self.path)
        if stored is not None:
            source.restore(stored)
        return source


def kind_of(path: Path) -> str:
    """What a file or folder holds, by its ending and, where that may be several things, what is in
    it."""
    from ..formats.arrays_file import dimensions, names
    from ..formats.cloud_file import READERS as CLOUDS
    from ..formats.cloud_file import TEXT
    from ..formats.grid_file import READERS as GRIDS
    from ..formats.ply import may_have_faces
    from .views.files import is_view_set

    if is_view_set(path):
        return "views"
    suffix = packed.ending(path)
    if suffix in TEXT or suffix in CLOUDS:
        return "points"
    if suffix in GRIDS:
        return "field"
    if suffix == ".npz":
        return "points" if "points" in names(path) else "field"
    if suffix == ".npy":
        return "points" if dimensions(path) == 2 else "field"
    if suffix == ".ply" and not may_have_faces(packed.beginning(path, PLY_HEADER)):
        return "points"
    return "mesh"


def identify(text: str, kind: str | None = None) -> Identity:
    """The input called ``text``: an existing path wins over a built-in field of that name, and
    that over a formula. ``kind`` is what the file holds, if that is not to be recognised.

    Raises InputError when it is none of them, or a file that cannot be read.
    """
    from .field.expression import looks_like_one
    from .field.source import FIELDS
    from .views.files import is_view_set

    path = Path(text)
    try:
        there = path.exists()
    except OSError:  # a formula may be too long for a path
        there = False
    if there:
        if path.is_dir() and kind not in (None, "views"):
            raise InputError(f"{path}: is a folder, but --kind {kind} needs a file")
        if not path.is_file() and not is_view_set(path):
            raise InputError(
                f"{path}: is a folder without cameras (transforms.json, or those of COLMAP, NDS, "
                "IDR or Middlebury); give a mesh, points, a field or a set of views"
            )
        return identify_path(kind or kind_of(path), path)
    if kind is not None:
        raise InputError(f"{text}: no such file; --kind {kind} needs the path of a file")
    if text in FIELDS or looks_like_one(text):
        return identify_field(text)
    raise InputError(
        f"{text}: no such file, and no built-in field of that name ({', '.join(sorted(FIELDS))}); "
        "check the path"
    )


def identify_path(kind: str, path: Path) -> Identity:
    """The input of that ``kind`` at ``path``, as it is on disk now. Raises InputError."""
    from .views.files import name_of, read

    if kind != "views":
        name, files = packed.stem(path), [path, *_files_beside(path)]
    else:
        name, files = name_of(path), read(path).all_files()
    if kind != "views" and len(files) == 1:
        return Identity(kind, name, path, path.stat().st_size, fingerprint.of_file(path))
    # A change of any picture, or of data beside their header, is a change of the input.
    parts = [[file.name, fingerprint.of_file(file)] for file in files]
    size = sum(file.stat().st_size for file in files)
    return Identity(kind, name, path, size, fingerprint.of_json(parts))


def _files_beside(path: Path) -> list[Path]:
    """Those that the header in ``path`` says hold the rest of it, if they are there.

    Raises InputError for a damaged gzip file.
    """
    from ..formats import gltf, grid_file

    of = gltf if packed.ending(path) in gltf.ENDINGS else grid_file
    try:
        return [file for file in of.files_beside(path) if file.is_file()]
    except OSError:  # the digest of the file says so
        return []


def identify_field(text: str) -> Identity:
    """The field called ``text``, or with ``text`` as its formula, or as ``module:function``.

    Raises InputError.
    """
    from .field.code import file_of, is_code
    from .field.expression import parse
    from .field.source import FIELDS

    if is_code(text):
        # A change of the code is a change of the input.
        return Identity("field", text, None, None, fingerprint.of_file(file_of(text)))
    if text not in FIELDS:
        parse(text)
    return Identity("field", text, None, None, None)
