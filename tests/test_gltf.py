"""Scenes of glTF: instances, units, extensions that are not read, buffers in other files."""

from __future__ import annotations

import base64
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import sphere_mesh

from vorolight.stages.errors import InputError
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.inputs.resolve import identify

VERTICES, TRIANGLES = sphere_mesh(1.0, 1)


def scene(positions: np.ndarray = VERTICES) -> tuple[dict[str, Any], bytes]:
    """A ball that three nodes show, one of them within another; and its buffer."""
    kinds = {"float32": 5126, "uint16": 5123, "int16": 5122}
    numbers = positions.astype(np.float32) if positions.dtype == np.float64 else positions
    rows = np.zeros((len(numbers), 4 * -(-3 * numbers.itemsize // 4)), np.uint8)
    rows[:, : 3 * numbers.itemsize] = numbers.view(np.uint8).reshape(len(numbers), -1)
    corners = TRIANGLES.astype("<u4").tobytes()
    buffer = rows.tobytes() + corners
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0},
            {"translation": [10, 0, 0], "scale": [2, 2, 2], "mesh": 0, "children": [2]},
            {"translation": [0, 4, 0], "rotation": [0, 0, 0.6, 0.8], "mesh": 0},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": kinds[numbers.dtype.name], "type": "VEC3",
             "count": len(numbers), "min": numbers.min(axis=0).tolist(),
             "max": numbers.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": TRIANGLES.size},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": rows.size, "byteStride": rows.shape[1]},
            {"buffer": 0, "byteOffset": rows.size, "byteLength": len(corners)},
        ],
        "buffers": [{"byteLength": len(buffer)}],
    }  # fmt: skip
    return tree, buffer


def glb(path: Path, tree: dict[str, Any], buffer: bytes) -> Path:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = len(text).to_bytes(4, "little") + b"JSON" + text
    body += len(buffer).to_bytes(4, "little") + b"BIN\0" + buffer
    head = b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little")
    path.write_bytes(head + body)
    return path


def test_a_mesh_that_several_nodes_show(tmp_path: Path) -> None:
    source = MeshSource(glb(tmp_path / "a.glb", *scene()))
    assert source.topology() == (6, 3)
    # In metres, as the format has it: coordinates are those of the file, y up.
    assert np.allclose(source.bounding_box(), [[-1, -2, -2], [12, 10, 2]], atol=0.1)


def test_quantised_positions(tmp_path: Path) -> None:
    whole = np.rint(1000 * (VERTICES + 1)).astype(np.uint16)
    tree, buffer = scene(whole)
    tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    tree["scenes"][0]["nodes"] = [0]
    tree["nodes"][0] |= {"scale": [0.001] * 3, "translation": [-1, -1, -1]}
    source = MeshSource(glb(tmp_path / "a.glb", tree, buffer))
    assert np.allclose(source.bounding_box(), [[-1, -1, -1], [1, 1, 1]], atol=2e-3)
    # These would be taken for numbers up to 32,767.
    tree["accessors"][0]["normalized"] = True
    with pytest.raises(InputError, match="whole numbers that stand for fractions"):
        MeshSource(glb(tmp_path / "b.glb", tree, buffer))


def instanced(tree: dict[str, Any]) -> None:
    tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}


CHANGES = {
    "every instance as a node or mesh of its own": instanced,
    r"compressed \(Draco\)": lambda tree: tree.update(
        extensionsUsed=["KHR_draco_mesh_compression"]
    ),
    r"compressed \(meshopt\)": lambda tree: tree.update(
        extensionsRequired=["KHR_meshopt_compression"]
    ),
    "requires the extension MY_shapes, which is not read": lambda tree: tree.update(
        extensionsRequired=["KHR_materials_unlit", "MY_shapes"]
    ),
    "fans of triangles": lambda tree: tree["meshes"][0]["primitives"][0].update(mode=6),
    "accessors are sparse": lambda tree: tree["accessors"][0].update(sparse={"count": 1}),
    "its meshes are damaged": lambda tree: tree.update(meshes=[1]),
    "not a readable GLB": lambda tree: tree.update(meshes=[{"primitives": [{}]}]),
}


@pytest.mark.parametrize("said", sorted(CHANGES))
def test_what_is_not_read_is_named(said: str, tmp_path: Path) -> None:
    tree, buffer = scene()
    CHANGES[said](tree)
    path = glb(tmp_path / "a.glb", tree, buffer)
    with pytest.raises(InputError, match=said) as error:
        MeshSource(path)
    assert str(path) in str(error.value)


def test_extensions_of_appearance_do_no_harm(tmp_path: Path) -> None:
    tree, buffer = scene()
    tree["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_transform"]
    assert MeshSource(glb(tmp_path / "a.glb", tree, buffer)).topology() == (6, 3)


def test_buffers_in_another_file_are_part_of_the_input(tmp_path: Path) -> None:
    tree, buffer = scene()
    tree["buffers"][0]["uri"] = "the%20ball.bin"
    (tmp_path / "the ball.bin").write_bytes(buffer)
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    assert MeshSource(path).topology() == (6, 3)
    packed = tmp_path / "a.gltf.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert MeshSource(packed).topology() == (6, 3)
    before = [identify(str(one)).sha256 for one in (path, packed)]
    assert before == [identify(str(one)).sha256 for one in (path, packed)]
    (tmp_path / "the ball.bin").write_bytes(bytes(4) + buffer[4:])
    after = [identify(str(one)).sha256 for one in (path, packed)]
    assert before[0] != after[0]
    assert before[1] != after[1]
    (tmp_path / "the ball.bin").unlink()
    with pytest.raises(InputError, match=r"a\.gltf: trimesh cannot read it"):
        MeshSource(path)
    tree["buffers"][0]["uri"] = (
        "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    )
    path.write_text(json.dumps(tree))
    assert MeshSource(path).topology() == (6, 3)
