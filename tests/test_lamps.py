"""Lamps: lights and bases on known shapes, and the real command with its files read back."""

from __future__ import annotations

import json
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import Cli, sphere_mesh
from manifold3d import Manifold

from vorolight.stages.errors import NumericalFailure, UsageError
from vorolight.stages.fabrication import base, lamp, lights, printcheck, slicer
from vorolight.stages.fabrication.base import Place
from vorolight.stages.formats import threemf
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.queries.parity import RayParity
from vorolight.stages.mesh.solids import solid_of
from vorolight.stages.render import lit

BALL = PolygonMesh.of_triangles(*sphere_mesh(1.0, 3))
TEA = lights.PRESETS["tea-light"]


def request(**changes: Any) -> lamp.Request:
    usual = {
        "up": "z", "height": 120.0, "overhang": 1.0, "trim": None, "base": "auto", "light": TEA,
        "preset": "tea-light", "clearance": 0.5, "wall": 1.6, "lid": False, "bed": (250, 250, 250),
    }  # fmt: skip
    return lamp.Request(**(usual | changes))


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_mm_from_input_is_a_rotation_with_the_asked_height(up: str) -> None:
    vertices = np.random.default_rng(0).random((50, 3)) * [1, 2, 3] + 5
    matrix = lamp.mm_from_input(vertices, up, 100.0, 0.04, 0.6)
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    assert scale > 0
    assert np.allclose(linear @ linear.T, scale**2 * np.eye(3))
    z = (vertices @ linear.T + matrix[:3, 3])[:, 2]
    assert z.max() == pytest.approx(99.4)
    assert z.min() == pytest.approx(-0.04 * np.ptp(z))
    whole = lamp.mm_from_input(vertices, up, 100.0, 0.0, 0.6)
    z = (vertices @ whole[:3, :3].T + whole[:3, 3])[:, 2]
    assert (z.min(), z.max()) == pytest.approx((0.6, 99.4))


def test_the_cavity_goes_where_there_is_room() -> None:
    stance = lamp.stand(BALL, BALL, request())
    assert stance.base == "footprint"
    # The ball has a radius of 62 mm; its slice at the floor must hold a cup of 21.1 mm.
    assert stance.trim == 0.04
    assert (stance.place.x, stance.place.y) == pytest.approx((0, 0), abs=2)
    radius = 119 / (2 * (1 - 0.04))
    slack = np.sqrt(radius**2 - (radius * 0.92) ** 2) - 21.1
    assert 0 < stance.place.slack <= slack
    assert stance.room == pytest.approx(38 + 2 * slack, abs=5)


def test_a_room_that_stands_out_is_found_out() -> None:
    solid = solid_of(BALL.with_vertices(30 * BALL.vertices))
    rooms = [lights.Room(10.0, -20.0, 20.0)]
    assert base.lies_within(rooms, Place(0, 0, 0), solid)
    assert not base.lies_within(rooms, Place(13, 0, 0), solid)


def test_what_does_not_fit_is_refused_with_what_would() -> None:
    with pytest.raises(
        UsageError, match=r"the largest light of this height that fits is \d+ mm wide"
    ):
        lamp.stand(BALL, BALL, request(base="footprint", light=lights.Light(130.0, 20.0)))
    with pytest.raises(UsageError, match="no light of this height fits"):
        lamp.stand(BALL, BALL, request(base="footprint", light=lights.Light(10.0, 119.0)))
    found = lamp.stand(
        BALL, BALL, request(light=lights.PRESETS["largest"], preset="largest", trim=0.1)
    )
    radius = 119 / (2 * 0.9)
    widest = 2 * (np.sqrt(radius**2 - (0.8 * radius) ** 2) - 2.1)
    # The grid of 1 mm takes up to three cells, and whole millimetres are said.
    assert widest - 5 < found.cavity.light.diameter <= widest


def test_pedestals_carry_what_stands_beside_the_window() -> None:
    puck = lights.PRESETS["puck"]
    assert lamp.stand(BALL, BALL, request(light=puck)).trim == 0.1
    stance = lamp.stand(BALL, BALL, request(light=puck, base="pedestal"))
    assert stance.lift == stance.cavity.top
    placed = stance.apply(BALL)
    assert placed.vertices[:, 2].max() == pytest.approx(119)
    standing = lamp.bodies(stance, placed, placed, 5.0)
    body = standing.add[0]
    for added in standing.add[1:]:
        body += added
    upper = solid_of(placed).trim_by_plane((0, 0, 1), stance.lift - 0.5)
    for taken in standing.remove:
        body -= taken
    assert len((body + upper).decompose()) == 1
    # The light's room is empty, and walls are around it but for the cable.
    light = Manifold.cylinder(27, 34, 34, 64).translate((stance.place.x, stance.place.y, 0))
    assert (body ^ light).volume() < 1e-6
    with pytest.raises(UsageError, match="pedestal would take"):
        lamp.stand(BALL, BALL, request(light=puck, base="pedestal", trim=0.2, height=60.0))


def test_a_bayonet_lid_goes_in_and_locks() -> None:
    cavity = lights.cavity(TEA, 0.5, 1.6, lid=True)
    place = Place(3.0, -2.0, 0.0)
    cup, empty = base.cup_bodies(cavity, place, 0.7)
    body = cup - empty
    lid = base.lid_body(cavity, place, None, 0.7)

    def turned(degrees: float, down: float) -> Manifold:
        back = lid.translate((-place.x, -place.y, -down)).rotate((0, 0, degrees))
        return back.translate((place.x, place.y, 0))

    for down in (0.0, 2.0, 4.0):  # the way in
        assert (turned(base.RUN, down) ^ body).volume() < 1e-6
    for degrees in np.linspace(0, base.RUN, 9):  # the turn
        assert (turned(degrees, 0.0) ^ body).volume() < 1e-6
    assert (turned(0.0, 1.0) ^ body).volume() > 5  # locked: it does not come out
    assert len(body.decompose()) == 1


def test_sockets_have_a_ring_and_room_for_the_bulb() -> None:
    cavity = lights.cavity(lights.PRESETS["e14"], 0.5, 1.6, lid=False)
    cup, empty = base.cup_bodies(cavity, Place(0, 0, 0), 0.0)
    ring = (cup - empty).slice(cavity.height + 1)
    assert ring.area() == pytest.approx(np.pi * (cavity.outer**2 - 14.5**2), rel=0.01)
    assert cavity.bulb == lights.Room(23.0, cavity.top, cavity.top + 80.5)


@pytest.fixture(scope="module")
def ball_run(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """A small sphere with its cells, nothing fabricated yet."""
    folder = tmp_path_factory.mktemp("ball")
    words = ["-n", 6, "--faces", "polygon", "--edge-length", 1.0, "--inner", 12, "--threads", 2]
    done = cli("run", "sphere", *words, "--until", "volume", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "sphere.vorolight"


Make = Callable[..., dict[str, Any]]
COARSE = ("--lamp", "--cell-size", "16mm")
"""A lamp of a third of the tubes, for what does not depend on their number."""


@pytest.fixture
def make(ball_run: Path, tmp_path: Path, cli: Cli) -> Make:
    """Fabricates in a copy of that run; what it measured."""
    folder = tmp_path / "sphere.vorolight"
    shutil.copytree(ball_run, folder)

    def call(*words: object) -> dict[str, Any]:
        done = cli("fabricate", *words, "--sides", 6, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        metrics: dict[str, Any] = json.loads((folder / "fabricate.json").read_text())["metrics"]
        return metrics | {"folder": folder, "stderr": done.stderr}

    return call


def test_a_lamp_and_its_files(make: Make) -> None:
    found = make("--lamp", "--height", "12cm", "--formats", "obj,glb", "--cable", 5)
    folder = found["folder"]
    for kind in ("stl", "3mf", "obj", "glb"):
        assert printcheck.check(folder / f"fabricate.{kind}").fault() is None
    sizes = {
        kind: printcheck.check(folder / f"fabricate.{kind}").size_mm for kind in ("stl", "glb")
    }
    assert sizes["glb"] == pytest.approx(sizes["stl"], abs=1e-3)
    assert sizes["stl"][2] == pytest.approx(120, abs=0.5)
    lattice = found["lattice"]
    assert lattice["unexplained"] == 0
    assert lattice["genus"] == lattice["edges_less_nodes_plus_parts"] - lattice["closed_faces"]
    assert lattice["closed_faces"] == found["plates"] + len(found["sealed_faces"])
    assert found["printable"]
    verdicts = {check["name"]: check for check in found["printability"]}
    assert verdicts["tubes"]["value"] >= 0.8
    assert verdicts["plates"]["value"] == pytest.approx(0.8, abs=1e-3)
    assert verdicts["layers"]["value"] == 600
    mesh = trimesh.load_mesh(folder / "fabricate.stl")
    light = found["light"]
    # Over the cable's channel there is a round hole for the light.
    section = mesh.section(plane_origin=[0, 0, 6.0], plane_normal=[0, 0, 1])
    radii = np.hypot(section.vertices[:, 0] - light["x_mm"], section.vertices[:, 1] - light["y_mm"])
    assert radii.min() == pytest.approx(light["cavity_diameter_mm"] / 2, rel=0.002)


def test_the_same_seed_gives_the_same_bytes(make: Make) -> None:
    kinds = ("stl", "3mf", "ply", "h5")
    folder = make(*COARSE)["folder"]
    first = [(folder / f"fabricate.{kind}").read_bytes() for kind in kinds]
    make(*COARSE, "--force")
    assert first == [(folder / f"fabricate.{kind}").read_bytes() for kind in kinds]
    make(*COARSE, "--seed", 1)
    assert first[0] != (folder / "fabricate.stl").read_bytes()


def test_a_lid_is_a_second_body(make: Make) -> None:
    found = make(*COARSE, "--bayonet", "--cable", 5)
    bodies = threemf.read((found["folder"] / "fabricate.3mf").read_bytes())
    assert [body.name for body in bodies] == ["lamp", "lid"]
    assert printcheck.check(found["folder"] / "fabricate.lid.stl").fault() is None
    assert found["as_written"]["files"]["3mf"]["bodies"] == 2


def test_solids_and_shells(make: Make) -> None:
    whole = make("--solid")["as_written"]["volume_mm3"]
    found = make("--solid", "--wall", "2mm")
    radius = (6 * whole / np.pi) ** (1 / 3) / 2
    assert found["as_written"]["volume_mm3"] == pytest.approx(4 * np.pi * radius**2 * 2, rel=0.25)
    checks = {check["name"]: check for check in found["printability"]}
    assert checks["shell"]["value"] >= 2.0
    mesh = trimesh.load_mesh(found["folder"] / "fabricate.stl")
    assert mesh.euler_number == 2  # open below: one surface, in and out
    found = make("--solid", "--base", "pedestal")["as_written"]
    assert (found["bodies"], found["size_mm"][2]) == (1, pytest.approx(120, abs=1e-3))


def test_cells_as_tubes_and_apart(make: Make) -> None:
    found = make("--cells")
    assert found["lattice"]["unexplained"] == 0
    assert found["light"]["proved_inside"]
    mesh = trimesh.load_mesh(found["folder"] / "fabricate.stl")
    light = found["light"]
    at = np.array([[light["x_mm"], light["y_mm"], z] for z in np.linspace(0.5, 20, 20)])
    assert not RayParity(np.array(mesh.vertices), np.array(mesh.faces)).inside(at).any()
    inner = make("--lattice", "--edges", "volume")
    assert inner["tubes"] < found["tubes"]
    apart = make("--cells", "--explode", 1.5, "--formats", "glb")
    assert apart["as_written"]["bodies"] == apart["cells"] > 12
    volume = json.loads((found["folder"] / "volume.json").read_text())["metrics"]
    matrix = json.loads((found["folder"] / "fabricate.json").read_text())["frame"]
    scale = 1 / np.cbrt(np.linalg.det(np.array(matrix["input_from_model"])[:3, :3]))
    assert apart["volume_mm3"] == pytest.approx(volume["cell_volume_sum"] * scale**3, rel=1e-4)


def test_sockets_pedestals_and_hanging_lamps(make: Make) -> None:
    found = make(*COARSE, "--light", "e14", "--height", 160, "--plate-pattern", "even")
    assert found["light"]["proved_inside"]
    found = make(*COARSE, "--base", "pedestal", "--taper", 0.7)
    assert found["base"] == "pedestal"
    assert found["pedestal_mm"] > found["light"]["cavity_height_mm"]
    # The tubes are thinner at the top: they reach as high as asked for all the same.
    assert found["as_written"]["size_mm"][2] == pytest.approx(120, abs=0.3)
    hanging = make(*COARSE, "--light", "none", "--base", "none", "--plate-pattern", "checker")
    assert "light" not in hanging
    verdicts = {check["name"]: check["verdict"] for check in hanging["printability"]}
    assert verdicts["floating starts"] == "warn"  # the lowest nodes of a ball hang in the air


REFUSED = [
    (["--lamp", "--solid"], 2, "exclude each other"),
    (["--height", "tall"], 2, "a length"),
    (["--height", 300], 2, "the printer has room for 250"),
    (["--lamp", "--bed", "100x100x300"], 2, "object is 12"),
    (["--bed", "big"], 2, "width x depth x height"),
    (["--lamp", "--plates", 1.5], 2, "from 0 to 1"),
    (["--lattice", "--plates", 0.2], 2, "only --lamp and --cells"),
    (["--lattice", "--light", "puck"], 2, "only --lamp and --cells"),
    (["--lamp", "--tube-diameter", 20], 2, "would close"),
    (["--lamp", "--tube-diameter", "0.5mm"], 2, "two nozzles"),
    (["--lamp", "--tube-diameter", 1, "--taper", 0.5], 2, "become thinner than two nozzles"),
    (["--lamp", "--tube-diameter", 2, "--plate-thickness", 3], 2, "thicker than the tubes"),
    (["--height", 20, "--tube-diameter", 15], 2, "raise --height"),
    (["--lamp", "--light-height", 200], 2, "higher than the object"),
    (["--lamp", "--base", "footprint", "--light-diameter", 150], 2, "that fits is"),
    (["--lamp", "--base", "none", "--light", "e14"], 2, "leaves no place for a light"),
    (["--explode", 2], 2, "add --cells"),
    (["--solid", "--wall", 20, "--height", 30], 2, "no part of the shape is that thick"),
    (["--formats", "step"], 2, "must be one of obj, glb"),
    (["--lattice", "--merge", 100], 2, "contracts every edge"),
    (["--lattice", "--trim", 0.2], 2, "--trim: the object has no base"),
    (["--lattice", "--bayonet"], 2, "--bayonet: the object has no light"),
    (["--lamp", "--base", "none", "--cable", 3], 2, "--cable: the object has no light"),
    (["--lamp", "--light-diameter", 10, "--cable", 12], 2, "wider than half the cavity"),
    (["--lamp", "--light", "largest", "--base", "pedestal"], 2, "use another --base"),
    (["--solid", "--fillet"], 2, "--fillet: the object has no tubes"),
    (["--solid", "--wall", 6], 2, "would have no opening"),
    (["--solid", "--wall", 2, "--base", "none"], 2, "would have no opening"),
    (["--layer", 0.5], 2, "more than the width of the nozzle"),
    (["--cells", "--explode", 1.001], 2, "at least 1.01"),
]


@pytest.mark.parametrize(("words", "code", "reason"), REFUSED, ids=lambda v: str(v)[:40])
def test_bad_requests_leave_nothing(
    words: list[object], code: int, reason: str, ball_run: Path, cli: Cli
) -> None:
    before = sorted(ball_run.iterdir())
    done = cli("fabricate", *words, cwd=ball_run.parent)
    assert done.returncode == code, done.stderr
    assert reason in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 + done.stderr.count("fabricate: about")
    assert sorted(ball_run.iterdir()) == before


def fake_slicer(folder: Path, script: str) -> Path:
    path = folder / "slicer"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_files_of_another_object_do_not_stay(make: Make) -> None:
    folder = make(*COARSE, "--bayonet", "--formats", "obj")["folder"]
    assert (folder / "fabricate.lid.stl").exists()
    make("--lattice")
    left = sorted(path.suffix for path in folder.glob("fabricate.*"))
    assert left == [".3mf", ".h5", ".json", ".ply", ".stl"]


INFO = "manifold = yes\\nnumber_of_parts =  1\\n"
SLICERS = [
    ("exit 3", "ended with 3"),
    (f"printf '{INFO}open_edges = 4\\n'", "has to repair it (open_edges)"),
    ("printf 'manifold = no\\nnumber_of_parts = 1\\n'", "not manifold"),
    ("printf 'manifold = yes\\nnumber_of_parts = 2\\n'", "2 parts instead of 1"),
    (f"printf '{INFO}'", "the slicer wrote nothing"),
    (
        f"""case "$1" in --info) printf '{INFO}';; *) for last; do
        case "$before" in -o) echo ';LAYER_CHANGE' > "$last";; esac; before=$last; done;; esac""",
        "1 layers of 0.2 mm where",
    ),
]


@pytest.mark.parametrize(("script", "reason"), SLICERS)
def test_slicers_that_complain(
    script: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(slicer.VARIABLE, str(fake_slicer(tmp_path, script)))
    path = tmp_path / "a.stl"
    path.write_bytes(b"")
    with pytest.raises(NumericalFailure) as caught:
        slicer.slice_file(path, 100.0, 0.2, 0.4, (250, 250, 250))
    assert reason in str(caught.value)


def test_no_slicer_is_said(ball_run: Path, cli: Cli) -> None:
    done = cli("fabricate", "--slice", cwd=ball_run.parent, env={slicer.VARIABLE: "no-such"})
    assert done.returncode == 69
    assert "not installed" in done.stderr


@pytest.mark.skipif(shutil.which("prusa-slicer") is None, reason="PrusaSlicer is not installed")
def test_a_real_slicer_takes_the_lamp(make: Make) -> None:
    found = make("--lamp", "--height", 80, "--layer", 0.4, "--nozzle", 0.6, "--slice")
    sliced = found["as_written"]["slicer"]
    assert (sliced["parts"], sliced["layers"] in (199, 200)) == (1, True)  # the last may be thin
    assert sliced["filament_g"] > 5


@pytest.mark.parametrize("traced", [True, False])
@pytest.mark.parametrize("night", [True, False])
def test_lit_pictures(night: bool, traced: bool) -> None:
    from io import BytesIO

    from PIL import Image

    vertices, triangles = sphere_mesh(30.0, 2)
    cage = vertices + np.array([0, 0, 30])
    light = (0.0, 0.0, 30.0) if night else None
    sheets = np.concatenate([triangles[::2], triangles[::2, ::-1]])
    scene = cage.astype(np.float32), sheets, light
    data = lit.png(*scene, 2, samples=16, size=96) if traced else lit.rasterised(*scene)
    picture = np.asarray(Image.open(BytesIO(data)).convert("RGB"), float)
    size = 96 if traced else lit.SIZE
    assert picture.shape == (size, size, 3)
    third, eighth = size // 3, size // 8
    middle, corner = picture[third:-third, third:-third], picture[:eighth, :eighth]
    if night:  # warm light within, little around it
        assert middle.mean() > 1.5 * corner.mean()
        shone = middle[(middle[..., 0] > 40) & (middle[..., 0] < 250)]  # not the light itself
        assert shone[:, 0].mean() > 1.1 * shone[:, 2].mean()
    else:
        assert corner.mean() > 100


@pytest.mark.slow
def test_the_lit_picture_of_a_lamp(make: Make) -> None:
    found = make("--lamp", "--height", 100, "--render")
    assert (found["folder"] / "fabricate.png").stat().st_size > 50_000
