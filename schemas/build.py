"""Writes the schemas of the manifests from the stages' Params:
``python -m vorolight.schemas.build``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vorolight import schemas


def stage_schema(name: str) -> dict[str, Any]:
    """The schema of the manifests of stage ``name``: the common part and its parameters."""
    from vorolight.stages.engine import registry
    from vorolight.stages.engine.params import params_schema

    # Only the manifest of classify must name the files of the input.
    inputs = {"inputs": {"minItems": 1}} if name == "classify" else {}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": schemas.identifier(name),
        "title": f"Manifest of stage {name}",
        "$ref": schemas.identifier("common"),
        "properties": {
            "schema": {"const": schemas.identifier(name)},
            "stage": {"const": name},
            "params": params_schema(registry.get(name).params),
            **inputs,
        },
    }


def encode(schema: dict[str, Any]) -> str:
    return json.dumps(schema, indent=2) + "\n"


def main() -> None:
    from vorolight.stages.engine import registry

    for name in registry.ALL:
        path = Path(__file__).parent / f"{name}.json"
        path.write_text(encode(stage_schema(name)), encoding="utf-8")
        print(path.name)


if __name__ == "__main__":
    main()
