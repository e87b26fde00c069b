"""Files of point clouds."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from conftest import Cli, fibonacci

from vorolight.stages.errors import InputError
from vorolight.stages.formats import cloud_file
from vorolight.stages.inputs.points.source import PointSource
from vorolight.stages.inputs.resolve import identify, kind_of


def write_expe(path: Path, points: np.ndarray, normals: np.ndarray) -> None:
    head = "[Expe/PointSet/Binary/0.1]\nproperty position 12\nproperty radius 4\nproperty normal 12"
    body = b"".join(
        struct.pack("<3ff3f", *point, 1.0, *normal)
        for point, normal in zip(points, normals, strict=True)
    )
    path.write_bytes(f"{head}\nnofpoints {len(points)}\ndata\n".encode() + body)


def test_every_format_reads_the_same(tmp_path: Path) -> None:
    points = fibonacci(200, 2.0).astype(np.float32).astype(np.float64)
    normals = points / 2
    table = np.concatenate([points, normals], axis=1)
    np.savetxt(tmp_path / "a.xyz", table)
    np.savetxt(tmp_path / "b.csv", table, delimiter=",", header="x,y,z,nx,ny,nz", comments="")
    np.savetxt(tmp_path / "c.pts", table, header="200", comments="")
    np.savetxt(tmp_path / "d.asc", table, delimiter=" ; ", header="# made by hand")
    np.save(tmp_path / "e.npy", table)
    np.savez(tmp_path / "f.npz", points=points, normals=normals)
    write_expe(tmp_path / "g.pts", points, normals)
    header = "ply\nformat {} 1.0\nelement vertex 200\n" + "".join(
        f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    header += "end_header\n"
    for name, kind, body in (
        ("h", "binary_little_endian", table.astype("<f8").tobytes()),
        ("i", "binary_big_endian", table.astype(">f8").tobytes()),
        ("j", "ascii", "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode()),
    ):
        (tmp_path / f"{name}.ply").write_bytes(header.format(kind).encode() + body)
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == 10
    for path in paths:
        assert kind_of(path) == "points", path.name
        found = cloud_file.load(path)
        assert np.allclose(found.points, points, atol=1e-6), path.name
        assert found.normals is not None, path.name
        assert np.allclose(found.normals, normals, atol=1e-6), path.name


@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_pcd_is_read(mode: str, tmp_path: Path) -> None:
    points = fibonacci(200, 2.0).astype(np.float32)
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z normal_x normal_y normal_z\n"
    head += "SIZE 4 4 4 4 4 4 4\nTYPE U F F F F F F\nCOUNT 1 1 1 1 1 1 1\nWIDTH 200\nHEIGHT 1\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 200\nDATA {mode}\n"
    if mode == "ascii":
        rows = [f"7 {' '.join(map(repr, at.tolist() + (at / 2).tolist()))}" for at in points]
        body = "\n".join(rows).encode()
    else:
        body = b"".join(struct.pack("<I6f", 7, *at, *(at / 2)) for at in points)
    path = tmp_path / "a.pcd"
    path.write_bytes(head.encode() + body)
    assert kind_of(path) == "points"
    found = cloud_file.load(path)
    assert np.allclose(found.points, points, atol=1e-6)
    assert found.normals is not None
    assert np.allclose(found.normals, points / 2, atol=1e-6)
    path.write_bytes(head.replace(mode, "binary_compressed").encode() + body)
    with pytest.raises(InputError, match="its data are binary_compressed"):
        cloud_file.load(path)
    if mode == "binary":
        for size in ("999999999", "1", "x"):
            path.write_bytes(head.replace("SIZE 4 4", f"SIZE 4 {size}").encode() + body)
            with pytest.raises(InputError, match=r"sizes|one byte"):
                cloud_file.load(path)
    path.write_bytes((head.encode() + body)[:-30])
    if mode == "binary":
        with pytest.raises(InputError, match="not a readable point cloud"):
            cloud_file.load(path)


def test_colours_are_no_normals(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).integers(0, 255, (200, 3))
    np.savetxt(tmp_path / "a.xyz", np.concatenate([fibonacci(200), colours], axis=1))
    np.savetxt(
        tmp_path / "b.pts", np.concatenate([fibonacci(200), colours[:, :1], colours], axis=1)
    )
    for name in ("a.xyz", "b.pts"):
        found = cloud_file.load(tmp_path / name)
        assert found.normals is None
        assert np.allclose(found.points, fibonacci(200))


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    points = np.concatenate([fibonacci(2000), fibonacci(2000)[:7], np.full((3, 3), np.nan)])
    np.save(tmp_path / "a.npy", points)
    source = PointSource(tmp_path / "a.npy")
    assert (source.cloud.doubled, source.cloud.not_finite) == (7, 3)
    assert np.array_equal(source.cloud.points, fibonacci(2000))
    assert any(
        "3 points have coordinates that are not finite" in said for said in source.warnings()
    )
    assert source.describe()["points"] == 2000


def test_large_clouds_are_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud_file, "MOST", 500)
    np.save(tmp_path / "a.npy", fibonacci(800))
    found = cloud_file.load(tmp_path / "a.npy")
    assert (len(found.points), found.thinned) == (500, 300)


def lines(head: str, row: str, joined: str = "\n") -> str:
    """A text with a row for each of 200 points of a sphere of radius 20 about (10, 20, 30)."""
    points = np.add(fibonacci(200, 20.0), [10, 20, 30])
    rows = [row.format(x=x, y=y, z=z, k=k) for k, (x, y, z) in enumerate(points)]
    return joined.join([*([head] if head else []), *rows]) + joined


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (lines(",x,y,z", "{k},{x:.6f},{y:.6f},{z:.6f}"), ""),
        (lines("id;X [m];Y [m];Z [m]", "{k};{x:.6f};{y:.6f};{z:.6f}"), ""),
        (lines("# t z y x", "{k} {z:.6f} {y:.6f} {x:.6f}"), ""),
        (lines("//X Y Z Intensity", "{x:.6f} {y:.6f} {z:.6f} 7"), ""),
        (lines('"Points:0","Points:1","Points:2","f"', "{x:.6f},{y:.6f},{z:.6f},1.5"), ""),
        (lines("", '"{x:.6f}","{y:.6f}","{z:.6f}"'), ""),
        (lines("# made by a scanner", "{x:.6f} {y:.6f} {z:.6f} 5"), "columns 1, 2 and 3 of 4"),
        (lines("class,x,y,z", "low vegetation,{x:.6f},{y:.6f},{z:.6f}"), ""),
        (lines("", "{x:.6f}\t{y:.6f}\t{z:.6f}\tground"), ""),
        (lines("200", "{x:.6f} {y:.6f} {z:.6f} 120 9 8 7"), "columns 1, 2 and 3 of 7 are taken"),
        (lines("", "{x:.6f} {y:.6f} {z:.6f}", "\r\n"), ""),
        # Rows of three and of four numbers.
        (lines("", "{x:.6f} {y:.6f} {z:.6f}") + "10 20 50 1\n", ""),
    ],
)
def test_columns_are_found(text: str, note: str, tmp_path: Path) -> None:
    points = np.add(fibonacci(200, 20.0), [10, 20, 30])
    path = tmp_path / "a.csv"
    for coding in ("utf-8", "utf-8-sig", "utf-16"):
        path.write_bytes(text.encode(coding))
        found = cloud_file.load(path)
        assert np.allclose(found.points[:200], points, atol=1e-6)
        assert note in found.note
        assert bool(note) == bool(found.note)


@pytest.mark.parametrize("mark", [";", "\t", " "])
def test_decimal_commas(mark: str, tmp_path: Path) -> None:
    text = lines(f"X{mark}Y{mark}Z", mark.join(["{x:.6f}", "{y:.6f}", "{z:.6f}"]))
    (tmp_path / "a.csv").write_text(text.replace(".", ","))
    found = cloud_file.load(tmp_path / "a.csv")
    assert np.allclose(found.points, np.add(fibonacci(200, 20.0), [10, 20, 30]), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (lines("", "{k},{x:.6f},{y:.6f},{z:.6f}"), "column 1 only counts the rows"),
        (lines("", "16e8 {x:.6f} {y:.6f} {z:.6f}"), "column 1 are more than 1000 times"),
        (lines("a,b,c,d", "{x:.6f},{y:.6f},{z:.6f},1"), "called a, b, c, d; say which"),
    ],
)
def test_columns_that_are_no_coordinates_are_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        cloud_file.load(tmp_path / "a.csv")


def test_columns_that_are_asked_for(tmp_path: Path, cli: Cli) -> None:
    points = np.add(fibonacci(200, 20.0), [10, 20, 30])
    (tmp_path / "a.csv").write_text(lines("", "{k},{y:.6f},{x:.6f},{z:.6f}"))
    found = cloud_file.load(tmp_path / "a.csv", "3,2,4")
    assert np.allclose(found.points, points, atol=1e-6)
    assert found.note == ""
    assert found.columns == (3, 2, 4)
    (tmp_path / "b.csv").write_text(lines("t,east,north,up", "{k},{x:.6f},{y:.6f},{z:.6f}"))
    found = cloud_file.load(tmp_path / "b.csv", "east, North,up")
    assert np.allclose(found.points, points, atol=1e-6)
    for columns, said in (
        ("1,2", "name three columns"),
        ("1,2,9", "it has no column 9, but 4 columns: t, east"),
    ):
        with pytest.raises(InputError, match=said):
            cloud_file.load(tmp_path / "b.csv", columns)
    np.save(tmp_path / "a.npy", points)
    with pytest.raises(InputError, match="--columns applies to text files"):
        cloud_file.load(tmp_path / "a.npy", "1,2,3")
    done = cli("classify", "sphere", "-n", 6, "--columns", "1,2,3", cwd=tmp_path)
    assert done.returncode == 2
    assert "--columns: needs a point cloud" in done.stderr
    done = cli("init", "a.csv", "-n", 6, "--iterations", 1, cwd=tmp_path)
    assert done.returncode == 3
    assert "a.csv: not a readable point cloud (its column 1 only counts the rows" in done.stderr
    done = cli("classify", "a.csv", "-n", 6, "--columns", "3,2,4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # The later stages read the same columns, and so does the report.
    done = cli("init", "--iterations", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = cli("report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "left out" not in (tmp_path / "a.vorolight" / "report.html").read_text()


def test_texts_as_people_have_them(tmp_path: Path) -> None:
    points = fibonacci(300) * [3.0, 4.0, 5.0]

    def lines(pattern: str, begin: int = 0, end: int = 300) -> str:
        return "".join(
            pattern.format(*point, k=k) + "\n" for k, point in enumerate(points[begin:end].tolist())
        )

    colours = "{0!r} {1!r} {2!r} -1200 10 20 30"
    for name, text in {
        "count.pts": "300\n" + lines(colours),
        "words.pts": "300 points\n" + lines(colours),
        "blank.pts": "\n\n300\n\n" + lines(colours),
        "names.pts": "//X,Y,Z,Intensity\n300\n" + lines("{0!r} {1!r} {2!r} 5"),
        "title.pts": "# units: mm\nCOUNT 300\n" + lines(colours),
        "several.pts": f"100\n{lines(colours, 0, 100)}0\n200\n{lines(colours, 100)}",
        "quoted.csv": '"x","y","z"\n' + lines('"{0!r}","{1!r}","{2!r}"'),
        "nameless.csv": lines('"{0!r}","{1!r}","{2!r}"'),
        "last.csv": "x,y,z,class\n" + lines('{0!r},{1!r},{2!r},"low wall, old"'),
        "first.csv": "class,x,y,z\n" + lines("wall {k},{0!r},{1!r},{2!r}"),
        "class.txt": lines("wall {0!r} {1!r} {2!r}"),
        "mixed.xyz": lines("{0!r} {1!r} {2!r}", 0, 150) + lines("{0!r} {1!r} {2!r} 7", 150),
        "mixed.csv": lines("{0!r},{1!r},{2!r},7", 0, 150) + lines("{0!r},{1!r},{2!r}", 150),
        "ends.csv": lines("{0!r},{1!r},{2!r},"),
        "sep.csv": "sep=;\nx;y;z\n" + lines("{0!r};{1!r};{2!r}").replace(".", ","),
    }.items():
        for coding in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"):
            (tmp_path / name).write_bytes(text.encode(coding))
            found = cloud_file.load(tmp_path / name)
            assert np.allclose(found.points, points, atol=1e-9), (name, coding)
    # A count that is another is no count.
    (tmp_path / "several.pts").write_text(f"100\n{lines(colours, 0, 100)}150\n{lines(colours)}")
    with pytest.raises(InputError, match="line 102 has no numbers in columns 1, 2, 3: 150"):
        cloud_file.load(tmp_path / "several.pts")
    (tmp_path / "short.csv").write_text("x,y,z\n" + lines("{0!r},{1!r},{2!r}") + "1,,2\n")
    with pytest.raises(InputError, match="line 302 has no numbers in columns 1, 2, 3: 1,,2"):
        cloud_file.load(tmp_path / "short.csv")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"", "empty"),
        ("a.xyz", b"hello\nworld\n", "no row of three numbers"),
        ("a.xyz", b"0 0 0\n1 0 0\n0 1 0\n", "3 different points"),
        ("a.xyz", b"1 2 3\n" * 500, "1 different points"),
        ("a.xyz", b"0 0 0\n1 0 0 0 0\n" * 100, "2 different points"),
        ("a.xyz", b"0 0 1\n" * 300 + b"1 0 end\n", "line 301 has no numbers in columns 1, 2, 3"),
        ("a.csv", b"1,2\n" * 300, "no row of three numbers"),
        ("a.pts", b"\x00\x01\x02" * 300, "not a text file"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n", "0 different points"),
    ],
)  # fmt: skip
def test_bad_clouds(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        _ = cast(PointSource, identify(str(path)).open()).cloud
    assert str(path) in str(error.value)


def test_flat_clouds_are_refused(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((500, 2)) @ np.array([[1.0, 2, 3], [3, 1, -2]])
    np.save(tmp_path / "a.npy", points + 7)
    with pytest.raises(InputError, match="one plane"):
        _ = PointSource(tmp_path / "a.npy").cloud
