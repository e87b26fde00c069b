"""Damaged input files: one clear sentence, soon, and within bounds."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import sphere_mesh

from vorolight.stages.errors import InputError
from vorolight.stages.export import threemf

SECONDS, MEMORY_MB = 10.0, 2000.0
"""What opening one file may take."""


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


def _truncated(raw: bytearray, random: np.random.Generator) -> bytearray:
    return raw[: random.integers(len(raw))]


def _flipped(raw: bytearray, random: np.random.Generator) -> bytearray:
    for place in random.integers(len(raw), size=random.integers(1, 20)):
        raw[place] ^= 1 << int(random.integers(8))
    return raw


def _flipped_early(raw: bytearray, random: np.random.Generator) -> bytearray:
    for place in random.integers(min(len(raw), 300), size=3):
        raw[place] = int(random.integers(256))
    return raw


def _huge_counts(raw: bytearray, random: np.random.Generator) -> bytearray:
    huge = [b"999999999", b"4294967295", b"-1", b"18446744073709551615", b"0"]
    digits = [i for i, c in enumerate(raw[:600]) if chr(c).isdigit()]
    if not digits:
        return raw
    start = end = int(random.choice(digits))
    while start and chr(raw[start - 1]).isdigit():
        start -= 1
    while end < len(raw) and chr(raw[end]).isdigit():
        end += 1
    return raw[:start] + huge[random.integers(len(huge))] + raw[end:]


def _huge_words(raw: bytearray, random: np.random.Generator) -> bytearray:
    place = int(random.integers(max(1, min(len(raw) - 8, 400))))
    raw[place : place + 4] = b"\xff\xff\xff\x7f"
    return raw


def _not_numbers(raw: bytearray, random: np.random.Generator) -> bytearray:
    words = [b"nan", b"inf", b"-inf", b"1e999", b"x", b""]
    parts = raw.split(b" ")
    for place in random.integers(len(parts), size=5):
        parts[place] = bytearray(words[random.integers(len(words))])
    if len(parts) > 20:
        return bytearray(b" ".join(parts))
    place = int(random.integers(max(1, len(raw) - 8)))
    raw[place : place + 8] = np.array([np.nan, np.inf][place % 2]).tobytes()
    return raw


def _swapped(raw: bytearray, random: np.random.Generator) -> bytearray:
    start = int(random.integers(min(len(raw), 200)))
    rest = raw[start:]
    whole = len(rest) // 4 * 4
    turned = np.frombuffer(bytes(rest[:whole]), "<u4").byteswap().tobytes()
    return raw[:start] + turned + rest[whole:]


def _short_lines(raw: bytearray, random: np.random.Generator) -> bytearray:
    """A few lines only, or some of them twice."""
    lines = raw.split(b"\n")
    kept = sorted(random.integers(len(lines), size=random.integers(1, 8)))
    return bytearray(b"\n".join(lines[i] for i in kept))


DAMAGES: list[Callable[[bytearray, np.random.Generator], bytearray]] = [
    _truncated, _flipped, _flipped_early, _huge_counts, _huge_words, _not_numbers, _swapped,
    _short_lines,
]  # fmt: skip


def damaged(folder: Path, count: int) -> Iterator[tuple[str, Path]]:
    """Files with ``count`` damages each, and what is wrong with them."""
    for number, seed in enumerate(seeds(folder)):
        raw = seed.read_bytes()
        for case in range(count):
            random = np.random.default_rng([number, case])
            damage = DAMAGES[case % len(DAMAGES)]
            path = folder / f"damaged{''.join(seed.suffixes)}"
            path.write_bytes(bytes(damage(bytearray(raw), random)))
            yield f"{seed.name} {damage.__name__} {case}", path


def open_all(folder: str, count: int) -> None:
    """Open every damaged file; print what went wrong, and the worst of time and memory."""
    import resource
    import time

    from vorolight.stages.sources.fields import FieldSource
    from vorolight.stages.sources.mesh import MeshSource
    from vorolight.stages.sources.points import PointSource
    from vorolight.stages.sources.resolve import identify

    faults, opened, slowest, cases = [], 0, 0.0, 0
    for name, path in damaged(Path(folder), count):
        cases += 1
        start = time.perf_counter()
        try:
            source = identify(str(path)).open()
            if isinstance(source, FieldSource):
                source.bounding_box()
            elif isinstance(source, PointSource):
                _ = source.cloud
            elif isinstance(source, MeshSource):
                source.topology()
            opened += 1
        except InputError as error:
            if str(path) not in str(error) or "\n" in str(error):
                faults.append(f"{name}: says {error}")
        except BaseException as error:
            faults.append(f"{name}: {type(error).__name__} {error}"[:300])
        slowest = max(slowest, time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"cases": cases, "opened": opened, "faults": faults, "slowest": slowest,
                      "peak_mb": peak}))  # fmt: skip


def _opened(folder: Path, count: int) -> dict[str, object]:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_fuzz; "
    code += f"test_fuzz.open_all({str(folder)!r}, {count})"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True,
                          text=True, timeout=3000)  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _check(found: dict[str, object]) -> None:
    assert found["faults"] == []
    assert float(str(found["slowest"])) < SECONDS
    assert float(str(found["peak_mb"])) < MEMORY_MB
    # Some damages do no harm; if all files opened, none would have been damaged.
    assert 0 < int(str(found["opened"])) < int(str(found["cases"]))


def test_a_few_damaged_files(tmp_path: Path) -> None:
    _check(_opened(tmp_path, 8))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_damaged_files(tmp_path: Path) -> None:
    found = _opened(tmp_path, 60)
    assert int(str(found["cases"])) >= 2000
    _check(found)
