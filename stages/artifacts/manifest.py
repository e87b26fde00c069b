"""Manifests: the JSON file that makes a stage's outputs count. Written last."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from vorolight import schemas

from ..errors import ArtifactError
from . import fingerprint

Manifest = dict[str, Any]


def clean_numbers(value: Any) -> Any:
    """JSON values from numpy scalars and dataclass dictionaries; a NaN or infinity becomes null."""
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
    """The bytes of a manifest, checked against its schema."""
    schemas.validate(manifest)
    return (json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def read(path: Path) -> Manifest:
    """A manifest from disk. Raises ArtifactError when it is missing, damaged or not ours."""
    try:
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise ArtifactError(f"{path}: missing; run its stage first") from None
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{path}: not a readable manifest; delete it and run again") from error
    try:
        schemas.validate(manifest)
    except ValueError as error:
        raise ArtifactError(f"{path}: {error}; delete it and run its stage again") from error
    return dict(manifest)


def outputs_changed(folder: Path, manifest: Manifest, verify: bool) -> str | None:
    """Why the outputs are not the ones the manifest describes, or None.

    Sizes and modification times are compared, with ``verify`` the contents.
    """
    for output in manifest["outputs"]:
        path = folder / output["path"]
        try:
            state = path.stat()
        except OSError:
            return f"{path.name} is missing"
        if state.st_size != output["bytes"]:
            return f"{path.name} changed"
        touched = state.st_mtime_ns != manifest["volatile"]["mtime_ns"].get(path.name)
        if (verify or touched) and fingerprint.of_file(path) != output["sha256"]:
            return f"{path.name} changed"
    return None
