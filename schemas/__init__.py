"""JSON Schemas of the manifests (``*.json``) and the layouts of the HDF5 files (``layouts``)."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

VERSION = 1
"""Major version of the manifests. It is part of every schema's ``$id``."""


def identifier(name: str) -> str:
    """The absolute ``$id`` of a schema."""
    return f"urn:vorolight:manifest:{VERSION}:{name}"


@cache
def load(name: str) -> dict[str, Any]:
    """The schema of one stage's manifest, or ``common``. Raises ValueError if
    there is no such schema."""
    file = resources.files(__name__).joinpath(f"{name}.json")
    if not name.replace("-", "").isalpha() or not file.is_file():
        raise ValueError(f"there is no manifest schema called {name!r}")
    return dict(json.loads(file.read_text(encoding="utf-8")))


@cache
def _validator(name: str) -> Any:
    from jsonschema import Draft202012Validator
    from referencing import Registry, Resource

    common = Resource.from_contents(load("common"))
    registry: Any = Registry().with_resource(identifier("common"), common)
    return Draft202012Validator(load(name), registry=registry)


def validate(manifest: Any) -> None:
    """Check a manifest against the schema that it names. Raises ValueError with the first fault."""
    named = manifest.get("schema") if isinstance(manifest, dict) else None
    if not isinstance(named, str):
        raise ValueError("is no vorolight manifest")
    prefix, _, name = named.rpartition(":")
    if prefix != identifier("").rstrip(":"):
        raise ValueError(f"is of schema {named}, which this version does not read; upgrade")
    fault = next(_validator(name).iter_errors(manifest), None)
    if fault is not None:
        place = "/".join(str(part) for part in fault.absolute_path) or "top level"
        raise ValueError(f"breaks its schema at {place} ({fault.message[:120]})")
