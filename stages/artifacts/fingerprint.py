"""Hashes by which a result is recognised as that of its inputs and options."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from ..errors import InputError


def of_bytes(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def of_file(path: Path) -> str:
    """The sha256 of a file. Raises InputError if it cannot be read."""
    if path.exists() and not path.is_file():  # reading a pipe would never end
        raise InputError(f"{path}: is not a file; check the path")
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def of_json(value: Any) -> str:
    """The sha256 of the canonical JSON of ``value``: sorted keys, shortest exact numbers."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return of_bytes(text.encode("utf-8"))
