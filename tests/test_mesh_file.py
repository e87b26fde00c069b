"""Files of meshes: their formats, their faces, and what is no mesh."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import random_rotation, sphere_mesh, write_obj

from vorolight.stages.errors import InputError
from vorolight.stages.formats.mesh_file import load
from vorolight.stages.inputs.mesh.source import MeshSource
from vorolight.stages.inputs.resolve import kind_of
from vorolight.stages.mesh.geometry import enclosed_volume, triangle_normals
from vorolight.stages.mesh.queries.intersections import self_intersections

BAD = {
    "missing.obj": (None, "no such file"),
    "empty.obj": (b"", "empty"),
    "text.obj": (b"Dear friend,\nthis is no mesh.\n", "no surface"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 1\n", "no surface"),
    "word.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 1\nf one two three\n", "line 4"),
    "short.obj": (b"v 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n", "fewer than three"),
    "beyond.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 9\n", "does not exist"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 1\nf 1 2 3\n", "not finite"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "on a line"),
    "text.ply": (b"hello", "no PLY header"),
    "cut.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
                b"property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
                b"end_header\n0 0 0\n1 0 0\n", "not a readable PLY"),
    "huge.ply": (b"ply\nformat binary_little_endian 1.0\nelement vertex 900000000\n"
                 b"property float x\nproperty float y\nproperty float z\nelement face 9\n"
                 b"property list uchar int vertex_indices\nend_header\n", "more elements"),
    "short.stl": (b"solid nothing at all", "trimesh cannot read it|no surface"),
    "paper.pdf": (b"%PDF", "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_files_get_one_sentence(name: str, tmp_path: Path) -> None:
    content, reason = BAD[name]
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=reason) as caught:
        load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert content is None or path.read_bytes() == content


def test_obj_as_others_write_it(tmp_path: Path) -> None:
    text = "v\t0 0 0 # first\n  v 1 0 0\nv 0 1 0\nv 0 0 1\n"
    text += "f 1/1 3/2 \\\n 2/3 # base\nf -4//1 -3//1 -1//1\nf 2 3 4\nf 1 4 3\n"
    path = tmp_path / "tetrahedron.obj"
    path.write_text(text)
    source = MeshSource(path)
    assert source.polygons.face_vertices.tolist() == [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
    assert source.open_edges == 0
    path.write_text(text + "f 0 1 2\n")
    with pytest.raises(InputError, match="counts from 1"):
        load(path)


def test_obj_with_groups_lines_points_and_indices_from_the_end(tmp_path: Path) -> None:
    vertices, triangles = sphere_mesh(1.0, 2)
    plain = write_obj(tmp_path / "plain.obj", vertices, triangles)
    lines = ["mtllib a.mtl", "o ball", "v 9 9 9", "v 8 9 9", "p 1", "l 1 2", "l -1 -2", "p -1"]
    seen: dict[int, int] = {}
    for number, corners in enumerate(triangles):
        for corner in corners:
            if corner not in seen:
                seen[int(corner)] = len(seen) + 2
                lines += ["v {!r} {!r} {!r} 0.5 0.5 0.5".format(*vertices[corner].tolist())]
        if number % 50 == 0:
            lines += [f"g part{number} all", f"usemtl m{number}", "s off", "vt 0 0", "vn 0 0 1"]
        back = [seen[int(corner)] - len(seen) - 2 for corner in corners]
        lines += ["f " + " ".join(f"{index}/-1/-1" for index in back), "l -1 -2 -3"]
    (tmp_path / "grouped.obj").write_text("\n".join(lines) + "\n")
    mesh, other = (load(path).polygons for path in (plain, tmp_path / "grouped.obj"))
    assert other.vertex_count == mesh.vertex_count == 162
    assert np.array_equal(mesh.vertices[mesh.face_vertices], other.vertices[other.face_vertices])
    (tmp_path / "beyond.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\nf -1 -2 -4\n")
    with pytest.raises(InputError, match="a face refers to a vertex that does not exist"):
        load(tmp_path / "beyond.obj")


@pytest.mark.parametrize("turned", [False, True])
def test_concave_faces_are_triangulated(turned: bool, tmp_path: Path) -> None:
    # The ends of a U, and of a comb whose middle sees only some of its teeth.
    u = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    comb = [(0, 0), (9, 0)]
    comb += [(x, 5 if (9 - x) % 4 < 2 else 1) for x in range(9, 0, -2) for x in (x, x - 1)]
    for outline in (u, comb):
        at = np.array(outline, float)
        count = len(at)
        area = 0.5 * float(
            np.sum(at[:, 0] * np.roll(at[:, 1], -1) - np.roll(at[:, 0], -1) * at[:, 1])
        )
        assert area > 0
        around = float(np.linalg.norm(at - np.roll(at, -1, axis=0), axis=1).sum())
        vertices = np.concatenate([np.c_[at, np.zeros(count)], np.c_[at, np.full(count, 2.0)]])
        faces = [list(range(count))[::-1], list(range(count, 2 * count))]
        faces += [[k, (k + 1) % count, count + (k + 1) % count, count + k] for k in range(count)]
        if turned:
            vertices = vertices @ random_rotation(3).T
        source = MeshSource(write_obj(tmp_path / "prism.obj", vertices, faces))
        assert source.topology() == (2, 1)
        # Fans about the middle would overlap, and turn over in the gaps.
        _, each = triangle_normals(source.vertices, source.triangles)
        assert each.sum() == pytest.approx(2 * area + 2 * around)
        assert len(self_intersections(source.vertices, source.triangles)) == 0
        assert (source.polygons.valences == 4).sum() == count


def test_packed_files_are_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "ball.stl.xz").write_bytes(b"\xfd7zXZ\0")
    with pytest.raises(InputError, match="is compressed; unpack it"):
        MeshSource(tmp_path / "ball.stl.xz")


def test_formats_of_trimesh_are_read(tmp_path: Path) -> None:
    import trimesh

    vertices, triangles = sphere_mesh(1.0, 1)
    for suffix in ("stl", "off", "glb", "ply", "obj"):
        path = tmp_path / f"ball.{suffix}"
        trimesh.Trimesh(vertices, triangles, process=False).export(path)
        source = MeshSource(path)
        assert source.open_edges == 0
        assert source.inside(np.array([[0.0, 0, 0], [1.5, 0, 0]])).tolist() == [True, False]


def test_what_a_3mf_file_builds_is_read(tmp_path: Path) -> None:
    import lib3mf

    vertices, triangles = sphere_mesh(1.0, 1)
    wrapper = lib3mf.get_wrapper()
    model = wrapper.CreateModel()
    model.SetUnit(lib3mf.ModelUnit.CentiMeter)
    ball = model.AddMeshObject()
    for at in vertices:
        ball.AddVertex(lib3mf.Position((lib3mf.ctypes.c_float * 3)(*at)))
    for corners in triangles:
        ball.AddTriangle(lib3mf.Triangle((lib3mf.ctypes.c_uint32 * 3)(*map(int, corners))))

    def placed(scale: tuple[float, float, float], shift: float) -> object:
        transform = wrapper.GetIdentityTransform()
        for row, values in enumerate([*np.diag(scale).tolist(), [shift, 0.0, 0.0]]):
            for column, value in enumerate(values):
                transform.Fields[row][column] = value
        return transform

    both = model.AddComponentsObject()
    both.AddComponent(ball, placed((1, 1, 1), 0.0))
    both.AddComponent(ball, placed((-1, 2, 1), 3.0))
    model.AddBuildItem(both, placed((1, 1, 1), 10.0))
    model.AddBuildItem(ball, placed((0.5, 0.5, 0.5), 0.0))
    path = tmp_path / "scene.3mf"
    # Writing to a file would change the locale of the process.
    path.write_bytes(bytes(bytearray(model.QueryWriter("3mf").WriteToBuffer())))
    assert kind_of(path) == "mesh"
    source = MeshSource(path)
    assert source.loaded.polygons_kept
    assert source.topology() == (6, 3)
    assert np.allclose(source.bounding_box(), [[-5, -20, -10], [140, 20, 10]], atol=1e-5)
    # In millimetres, and mirrored parts face outward too.
    alone = enclosed_volume(vertices, triangles)
    volume = enclosed_volume(source.vertices, source.triangles)
    assert volume == pytest.approx(1000 * alone * (1 + 2 + 0.125), rel=1e-5)


def test_compressed_geometry_is_named(tmp_path: Path) -> None:
    for name, extension in (
        ("Draco", "KHR_draco_mesh_compression"), ("meshopt", "EXT_meshopt_compression")
    ):  # fmt: skip
        text = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": [extension]}).encode()
        (tmp_path / "a.gltf").write_bytes(text)
        head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text)).to_bytes(4, "little")
        (tmp_path / "a.glb").write_bytes(head + len(text).to_bytes(4, "little") + b"JSON" + text)
        for ending in ("gltf", "glb"):
            with pytest.raises(InputError, match=f"compressed \\({name}\\), which is not read"):
                MeshSource(tmp_path / f"a.{ending}")
