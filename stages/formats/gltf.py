"""Content of glTF files that trimesh would ignore or misread silently, found in their headers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from . import packed

ENDINGS = (".glb", ".gltf")
COMPRESSIONS = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
"""Extensions that compress geometry, and their common names."""
INSTANCES = "EXT_mesh_gpu_instancing"
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_")
"""Prefixes of extensions that do not affect geometry."""
READ = ("KHR_mesh_quantization",)
"""Extensions of geometry that are supported."""
FAN, FLOAT = 6, 5126
"""The mode of primitives that are fans of triangles, and the type of floating-point numbers."""


def refusal(raw: bytes) -> str | None:
    """Why the scene in ``raw``, a .glb or .gltf file, cannot be read correctly; None if it can.

    Only the header is examined. Raises ValueError if the header is not a JSON object.
    """
    tree = _header(raw)
    used = [name for key in ("extensionsRequired", "extensionsUsed") for name in tree.get(key, [])]
    for name in used:
        if name in COMPRESSIONS:
            return (
                f"its geometry is compressed ({COMPRESSIONS[name]}), which is not read; export it "
                "without compression"
            )
        if name == INSTANCES:
            return (
                f"its nodes are repeated by {INSTANCES}, which is not read; export every instance "
                "as a node or mesh of its own"
            )
    for name in tree.get("extensionsRequired", []):
        if name not in READ and not str(name).startswith(HARMLESS):
            return f"it requires the extension {name}, which is not read; export it without"
    accessors = list(_objects(tree, "accessors"))
    for mesh in _objects(tree, "meshes"):
        for primitive in _objects(mesh, "primitives"):
            if primitive.get("mode") == FAN:
                return "it holds fans of triangles, which are not read; export it as triangles"
            for index in (primitive["attributes"].get("POSITION"), primitive.get("indices")):
                if index is None:
                    continue
                accessor = accessors[index]
                if "sparse" in accessor:
                    return "its accessors are sparse, which is not read; export it without"
                if accessor.get("normalized") and accessor.get("componentType") != FLOAT:
                    return (
                        "its positions are whole numbers that stand for fractions, which is not "
                        "read; export it without quantisation"
                    )
    return None


def resolver(path: Path) -> Any:
    """An object that gives trimesh the files beside the one at ``path``.

    Their names are parts of URLs, in which a blank is written as %20.
    """
    from trimesh.resolvers import FilePathResolver

    class Unquoted(FilePathResolver):
        def get(self, name: str) -> bytes:
            return bytes(super().get(unquote(name)))

    return Unquoted(str(path))


def files_beside(path: Path) -> list[Path]:
    """The files with the buffers of the scene at ``path``, if its header can be read.

    Raises the same errors as ``packed.content``.
    """
    try:
        tree = _header(packed.content(path))
        places = [str(buffer.get("uri", "data:")) for buffer in _objects(tree, "buffers")]
    except (ValueError, TypeError, AttributeError):
        return []
    return [path.parent / unquote(uri) for uri in places if not uri.startswith("data:")]


def _header(raw: bytes) -> dict[str, Any]:
    if raw[:4] == b"glTF":
        raw = raw[20 : 20 + int.from_bytes(raw[12:16], "little")]
    try:
        tree = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"its header is no JSON: {error}") from error
    if not isinstance(tree, dict):
        raise ValueError("its header is no JSON object")
    return tree


def _objects(tree: dict[str, Any], key: str) -> Iterator[dict[str, Any]]:
    for item in tree.get(key, []):
        if not isinstance(item, dict):
            raise ValueError(f"its {key} are damaged")
        yield item
