"""Lists of shapes: a text file with one INPUT a line, for work on many shapes at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..formats import packed


@dataclass(frozen=True)
class Shape:
    """A line of a list."""

    input: str
    """As written: a path from the current folder, a built-in field or a formula."""
    kind: str
    stem: str
    """What its run folder is called after."""
    line: int
    """In the file, from 1."""

    @property
    def path(self) -> Path | None:
        """The file or folder, if it is one: an existing path wins over a field of that name."""
        return Path(self.input) if Path(self.input).exists() else None


def read(path: Path) -> list[Shape]:
    """The shapes listed in the file at ``path``; blank lines and those that begin with # are none.

    No shape is opened further than to see what it is. Raises InputError for a list that cannot be
    read or is empty, a line that is no input, and two shapes that would share a run folder.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a list with one INPUT on each line") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); give one INPUT on each line"
        ) from error
    shapes: dict[str, Shape] = {}
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            shape = Shape(text, *_recognised(text), number)
        except InputError as error:
            raise InputError(f"{path}, line {number}: {error}") from None
        first = shapes.setdefault(shape.stem, shape)
        if first is not shape:
            raise InputError(
                f"{path}, line {number}: {text} would share the run folder of {first.input} "
                f"(line {first.line}), {shape.stem}.vorolight; rename one of them"
            )
    if not shapes:
        raise InputError(f"{path}: has no shape; give one INPUT on each line")
    return list(shapes.values())


def _recognised(text: str) -> tuple[str, str]:
    """Kind and stem of an input, without the hash of a file's contents that ``identify`` makes."""
    from .resolve import identify, kind_of
    from .views.files import is_view_set, name_of

    path = Path(text)
    if path.is_file() or (path.is_dir() and is_view_set(path)):
        kind = kind_of(path)
        return kind, name_of(path) if kind == "views" else packed.stem(path)
    found = identify(text)
    return found.kind, found.stem
