"""A small input in every format that is read."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from conftest import sphere_mesh

from vorolight.stages.formats import threemf


def seeds(folder: Path) -> list[Path]:
    """A sound file of each format."""
    import nrrd
    import trimesh

    vertices, triangles = sphere_mesh(level=2)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    made = []
    for suffix in ("obj", "off", "stl", "glb", "ply"):
        made.append(folder / f"mesh.{suffix}")
        mesh.export(made[-1])
    made.append(folder / "text.ply")
    made[-1].write_bytes(mesh.export(file_type="ply", encoding="ascii"))
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    table = np.concatenate([vertices, normals], axis=1)
    for suffix, between in (("xyz", " "), ("csv", ","), ("pts", " ")):
        made.append(folder / f"points.{suffix}")
        np.savetxt(made[-1], table, delimiter=between, header="162" if suffix == "pts" else "",
                   comments="")  # fmt: skip
    made.append(folder / "named.csv")
    rows = ["id;X;Y;Z", *(";".join(map(str, [k, *at])) for k, at in enumerate(vertices))]
    made[-1].write_text("\n".join(rows).replace(".", ","))
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 162\nHEIGHT 1\n"
    made.append(folder / "binary.pcd")
    made[-1].write_bytes(f"{head}POINTS 162\nDATA binary\n".encode() + vertices.tobytes())
    made.append(folder / "text.pcd")
    text = "\n".join(" ".join(map(str, at)) for at in vertices)
    made[-1].write_text(f"{head}POINTS 162\nDATA ascii\n{text}\n")
    made.append(folder / "mesh.3mf")
    body = threemf.Body("ball", vertices.astype(np.float32), triangles)
    made[-1].write_bytes(threemf.encode([body], "ball", "test"))
    made.append(folder / "points.ply")
    trimesh.PointCloud(vertices).export(made[-1])
    made.append(folder / "points.npy")
    np.save(made[-1], table)
    made.append(folder / "points.npz")
    np.savez_compressed(made[-1], points=vertices, normals=normals)
    axis = np.linspace(-1.5, 1.5, 8)
    values = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) - 1
    made.append(folder / "field.npy")
    np.save(made[-1], values)
    made.append(folder / "field.npz")
    np.savez(made[-1], values=values, origin=np.full(3, -1.5), spacing=np.array(3 / 7))
    made.append(folder / "field.nrrd")
    nrrd.write(str(made[-1]), values)
    made.append(folder / "field.vti")
    made[-1].write_text(
        '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData Origin="0 0 0" '
        'Spacing="1 1 1"><Piece Extent="0 7 0 7 0 7"><PointData Scalars="f"><DataArray '
        'type="Float64" Name="f" format="ascii">'
        + " ".join(map(str, values.ravel(order="F")))
        + "</DataArray></PointData></Piece></ImageData></VTKFile>"
    )
    made += [*_volumes(folder, values), *_scans(folder, vertices)]
    for name in ("mesh.obj", "mesh.stl", "named.csv", "points.npz", "field.nrrd"):
        made.append(folder / f"{name}.gz")
        made[-1].write_bytes(gzip.compress((folder / name).read_bytes()))
    return made


def _volumes(folder: Path, values: np.ndarray) -> list[Path]:
    import nibabel

    made = [folder / "field.mha", folder / "field.mhd", folder / "field.nhdr"]
    flat = values.ravel(order="F").tobytes()
    head = "ObjectType = Image\nNDims = 3\nDimSize = 8 8 8\nElementType = MET_DOUBLE\n"
    head += "TransformMatrix = 0.6 0.8 0 -0.8 0.6 0 0 0 1\nOffset = 1 2 3\nElementSpacing = 1 1 2\n"
    made[0].write_bytes(f"{head}ElementDataFile = LOCAL\n".encode() + flat)
    made[1].write_text(f"{head}ElementDataFile = field.raw\n")
    (folder / "field.raw").write_bytes(flat)
    made[2].write_text(
        "NRRD0004\ntype: double\ndimension: 3\nsizes: 8 8 8\nencoding: raw\nendian: little\n"
        "data file: field.raw\n"
    )
    made += [folder / "field.nii", folder / "volume.nii.gz"]
    for path in made[-2:]:
        nibabel.save(nibabel.Nifti1Image(values.astype(np.float32), np.diag([2, 2, 2, 1.0])), path)
    return made


def _scans(folder: Path, vertices: np.ndarray) -> list[Path]:
    import laspy
    import pye57

    made = [folder / "scan.ptx", folder / "scan.las", folder / "scan.laz", folder / "scan.e57"]
    lines = [*("18", "9", "0 0 0", "1 0 0", "0 1 0", "0 0 1"),
             *("1 0 0 0", "0 1 0 0", "0 0 1 0", "7 8 9 1"),
             *(f"{x:.6f} {y:.6f} {z:.6f} 0.5" for x, y, z in vertices)]  # fmt: skip
    made[0].write_text("\n".join(lines) + "\n")
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    cloud.header.scales = np.full(3, 1e-6)
    cloud.x, cloud.y, cloud.z = vertices.T
    for path in made[1:3]:
        cloud.write(path)
    made[3].unlink(missing_ok=True)
    scan = pye57.E57(str(made[3]), mode="w")
    axes = {f"cartesian{axis}": vertices[:, k].copy() for k, axis in enumerate("XYZ")}
    scan.write_scan_raw(axes, rotation=np.array([1.0, 0, 0, 0]), translation=np.array([1.0, 2, 3]))
    scan.close()
    return made
