"""Manifests: the JSON file that commits the outputs of a stage. It is written last."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vorolight import schemas

from ..errors import ArtifactError
from . import fingerprint

Manifest = dict[str, Any]

LARGEST = 16_000_000
"""Largest size of a manifest in bytes. A large one has about fifty thousand."""


def clean_numbers(value: Any) -> Any:
    """``value`` as JSON values: NumPy scalars become numbers, NaN and infinity become null."""
    if isinstance(value, dict):
        return {str(key): clean_numbers(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [clean_numbers(item) for item in value]
    if hasattr(value, "tolist"):
        return clean_numbers(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def encode(manifest: Manifest) -> bytes:
    """The bytes of a manifest, with its checksums, checked against its schema."""
    sealed = _sealed(manifest)
    schemas.validate(sealed)
    return (json.dumps(sealed, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def _sealed(manifest: Manifest) -> Manifest:
    """The manifest with two checksums: one of what is the same in every
    run, and one of the rest."""
    kept = {key: value for key, value in manifest.items() if key not in ("checksum", "volatile")}
    volatile = {key: value for key, value in manifest["volatile"].items() if key != "checksum"}
    return {
        **kept,
        "checksum": fingerprint.of_json(kept),
        "volatile": {**volatile, "checksum": fingerprint.of_json(volatile)},
    }


def read(path: Path) -> Manifest:
    """The manifest at ``path``. Raises ArtifactError if it is missing, damaged, or
    not one of vorolight."""
    try:
        if path.stat().st_size > LARGEST or not leads_inside(path):
            raise ArtifactError(
                f"{path}: is too large, or leads out of this folder; delete it and run its stage "
                "again"
            )
        manifest = json.loads(path.read_bytes(), parse_constant=_no_number, parse_float=_finite)
    except FileNotFoundError:
        raise ArtifactError(f"{path}: missing; run its stage first") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not a readable manifest; delete it and run again") from error
    try:
        schemas.validate(manifest)
        if "checksum" in manifest and manifest != _sealed(manifest):
            raise ValueError("was changed after it was written")
        if not all(entry["path"].startswith(f"{path.stem}.") for entry in manifest["outputs"]):
            raise ValueError("belongs to another stage")
    # Deeply nested or strange values may make the validator itself fail.
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise ArtifactError(f"{path}: {said}; delete it and run its stage again") from error
    return dict(manifest)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is not a number")


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _no_number(text)


@contextmanager
def foreign(where: str) -> Iterator[None]:
    """A context in which figures of a manifest are read that somebody else may have changed.

    Errors about missing figures become ArtifactError.
    """
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, ZeroDivisionError) as error:
        raise ArtifactError(
            f"{where}: a figure is missing, or has another form than this version writes "
            f"({type(error).__name__}: {error}); run its stage again with --force"
        ) from error


def outputs_changed(folder: Path, manifest: Manifest, verify: bool) -> str | None:
    """Why the files are not those that the manifest describes, or None.

    Sizes and modification times are compared, and with ``verify`` also the contents.
    """
    for output in manifest["outputs"]:
        path = folder / output["path"]
        try:
            state = path.stat()
        except OSError:
            return f"{path.name} is missing"
        if not leads_inside(path):
            return f"{path.name} leads out of this folder"
        if state.st_size != output["bytes"]:
            return f"{path.name} changed"
        touched = state.st_mtime_ns != manifest["volatile"]["mtime_ns"].get(path.name)
        if (verify or touched) and fingerprint.of_file(path) != output["sha256"]:
            return f"{path.name} changed"
    return None


def leads_inside(path: Path) -> bool:
    """Whether a path is a regular file in the run folder, and not a folder, a device
    or a link to elsewhere."""
    return path.is_file() and path.resolve().parent == path.parent.resolve()
