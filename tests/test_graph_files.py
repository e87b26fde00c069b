"""The dual graph of the cells: its files, read back by other libraries and solved on."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import toughio
from conftest import Cli
from flopy.mf6 import (
    MFSimulation,
    ModflowGwf,
    ModflowGwfdisu,
    ModflowGwfic,
    ModflowGwfnpf,
    ModflowIms,
    ModflowTdis,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from vorolight.stages.errors import BackendMissing
from vorolight.stages.formats import disu, graph_files
from vorolight.stages.mesh.dual_graph import DualGraph

SLOPE = np.array([0.3, -1.2, 0.7])


@dataclass
class Read:
    """A grid as a solver has it: connections of cells, and walls ``(B,)`` with known values."""

    points: np.ndarray
    volume: np.ndarray
    cells: np.ndarray
    conductance: np.ndarray
    wall_cell: np.ndarray
    wall_conductance: np.ndarray
    wall_points: np.ndarray


def error_of(grid: Read) -> float:
    """The largest error of the solution of Laplace's equation whose values are linear."""
    a, b = grid.cells.T
    rows = np.concatenate([a, b, a, b, grid.wall_cell])
    columns = np.concatenate([a, b, b, a, grid.wall_cell])
    values = np.concatenate([*[grid.conductance] * 2, *[-grid.conductance] * 2,
                             grid.wall_conductance])  # fmt: skip
    count = len(grid.points)
    right = np.bincount(grid.wall_cell, grid.wall_conductance * (grid.wall_points @ SLOPE), count)
    found = spsolve(coo_array((values, (rows, columns)), (count, count)).tocsc(), right)
    exact = grid.points @ SLOPE
    return float(np.abs(found - exact).max() / np.ptp(exact))


@pytest.fixture(scope="module")
def exported(
    heart_run: Path, cli: Cli, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Path]:
    """Export cells whose faces were not changed, under a name, once."""
    folder = tmp_path_factory.mktemp("graph")
    run = folder / "heart.vorolight"
    shutil.copytree(heart_run, run)
    done = cli("volume", "--inner", 60, "--sliver", 0, "--run", run, cwd=folder)
    assert done.returncode == 0, done.stderr

    def write(name: str, form: str, *words: object) -> Path:
        if not (folder / name).exists():
            done = cli("export", name, "--format", form, "--run", run, *words, cwd=folder)
            assert done.returncode == 0, done.stderr
            assert "generators are perpendicular to the faces" in done.stdout
        return folder / name

    return write


def table(path: Path) -> dict[str, np.ndarray]:
    found = np.genfromtxt(path, delimiter=",", names=True)
    return {name: found[name] for name in found.dtype.names}


def places(rows: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([rows[axis] for axis in "xyz"], axis=1)


def test_linear_functions_are_exact_on_the_tables(exported: Callable[..., Path]) -> None:
    folder = exported("tables", "graph-csv")
    cells, pairs, walls = (
        table(folder / f"{name}.csv") for name in ("cells", "connections", "boundary")
    )
    both = np.stack([pairs["cell"], pairs["other"]], axis=1).astype(int)
    grid = Read(
        places(cells), cells["volume"], both,
        pairs["area"] / (pairs["distance"] + pairs["other_distance"]),
        walls["cell"].astype(int), walls["area"] / walls["distance"], places(walls),
    )  # fmt: skip
    assert error_of(grid) < 1e-10
    # The face lies halfway between the generators, and the normal goes along their line.
    assert pairs["distance"] == pytest.approx(pairs["other_distance"], rel=1e-6)
    way = grid.points[both[:, 1]] - grid.points[both[:, 0]]
    normal = np.stack([pairs[f"normal_{axis}"] for axis in "xyz"], axis=1)
    length = pairs["distance"] + pairs["other_distance"]
    assert normal * length[:, None] == pytest.approx(way, abs=1e-12)
    # Gauss: the volume is a third of the sum of the pyramids over the boundary.
    outward = np.stack([walls[f"normal_{axis}"] for axis in "xyz"], axis=1)
    flux = walls["area"] * np.einsum("ij,ij->i", outward, grid.wall_points)
    assert flux.sum() / 3 == pytest.approx(cells["volume"].sum(), rel=1e-10)


def test_pflotran_takes_the_distances_of_the_generators(exported: Callable[..., Path]) -> None:
    folder = exported("pflotran", "pflotran")
    lines = (folder / "mesh.uge").read_text().split("\n")
    count = int(lines[0].removeprefix("CELLS "))
    cells = np.array([line.split() for line in lines[1 : count + 1]], float)
    assert lines[count + 1].startswith("CONNECTIONS ")
    pairs = np.array([line.split() for line in lines[count + 2 : -1]], float)
    assert len(pairs) == int(lines[count + 1].split()[1])
    assert np.array_equal(cells[:, 0], np.arange(1, count + 1))
    walls = np.loadtxt(folder / "surface.ex", skiprows=1)
    points = cells[:, 1:4]
    both = pairs[:, :2].astype(int) - 1
    # Of the point of a connection PFLOTRAN uses the distance from either cell.
    lengths = sum(np.linalg.norm(pairs[:, 2:5] - points[side], axis=1) for side in both.T)
    wall = walls[:, 0].astype(int) - 1
    reach = np.linalg.norm(walls[:, 1:4] - points[wall], axis=1)
    grid = Read(points, cells[:, 4], both, pairs[:, 5] / lengths, wall, walls[:, 4] / reach,
                walls[:, 1:4])  # fmt: skip
    assert error_of(grid) < 1e-10


def test_tough_has_inactive_elements_at_the_boundary(exported: Callable[..., Path]) -> None:
    path = exported("tough", "tough") / "MESH"
    assert max(map(len, path.read_text().split("\n"))) == 80
    found = toughio.read_input(path)
    names = {name: number for number, name in enumerate(found["elements"])}
    elements, links = list(found["elements"].values()), found["connections"]
    volume = np.array([element["volume"] for element in elements])
    count = int((volume > 0).sum())
    assert (volume[:count] > 0).all()
    points = np.array([element["center"] for element in elements])
    both = np.array([(names[name[:5]], names[name[5:]]) for name in links])
    distance = np.array([link["nodal_distances"] for link in links.values()])
    area = np.array([link["interface_area"] for link in links.values()])
    slope = np.array([link["gravity_cosine_angle"] for link in links.values()])
    wall = both[:, 1] >= count
    assert distance[wall, 1].max() == 0
    assert wall.sum() == len(elements) - count
    rise = points[both[:, 1], 2] - points[both[:, 0], 2]
    # Positive where the first element is above the second. Values have at least four digits.
    assert slope == pytest.approx(-rise / distance.sum(axis=1), abs=5e-3)
    conductance = area / distance.sum(axis=1)
    grid = Read(points[:count], volume[:count], both[~wall], conductance[~wall],
                both[wall, 0], conductance[wall], points[both[wall, 1]])  # fmt: skip
    assert error_of(grid) < 1e-4


def test_modflow_has_the_conductances_of_the_graph(
    exported: Callable[..., Path], tmp_path: Path
) -> None:
    path = exported("modflow", "modflow") / "mesh.disu"
    assert path.read_bytes().startswith(b"BEGIN options")
    simulation = MFSimulation(sim_ws=tmp_path, verbosity_level=0)
    ModflowTdis(simulation)
    ModflowIms(simulation)
    model = ModflowGwf(simulation, modelname="mesh")
    ModflowGwfdisu(
        model, nodes=1, nja=1, top=1.0, bot=0.0, area=1.0, iac=1, ja=0, ihc=1, cl12=0.0, hwva=0.0,
        filename="mesh.disu",
    )  # fmt: skip
    ModflowGwfic(model)
    ModflowGwfnpf(model)
    simulation.write_simulation(silent=True)
    shutil.copy(path, tmp_path / "mesh.disu")
    grid = MFSimulation.load(sim_ws=tmp_path, verbosity_level=0).get_model("mesh").disu
    iac, ja, width, length = (
        np.asarray(getattr(grid, name).get_data()) for name in ("iac", "ja", "hwva", "cl12")
    )
    cell = np.repeat(np.arange(len(iac)), iac)
    own = cell == ja
    starts = np.cumsum(iac) - iac
    assert own[starts].all()
    assert own.sum() == len(iac)
    with h5py.File(exported("graph.h5", "graph-hdf5")) as file:
        graph = DualGraph(**{name: file[name][:] for name in file})
    thickness = np.asarray(grid.top.get_data()) - np.asarray(grid.bot.get_data())
    assert thickness * np.asarray(grid.area.get_data()) == pytest.approx(graph.volume, rel=1e-9)
    # A width times the thickness is the area of a face; both sides have the same.
    order = np.lexsort([ja[~own], cell[~own]])
    back = np.lexsort([cell[~own], ja[~own]])
    assert width[~own][order] == pytest.approx(width[~own][back])
    total = length[~own][order] + length[~own][back]
    inner = slice(0, graph.inner)
    ahead = cell[~own][order] < ja[~own][order]
    found = width[~own][order][ahead] * thickness[0] / total[ahead]
    exact = graph.area[inner] / graph.distance[inner].sum(axis=1)
    assert found == pytest.approx(exact, rel=1e-8)


def test_a_cut_has_faces_of_a_boundary(exported: Callable[..., Path]) -> None:
    whole = table(exported("tables", "graph-csv") / "boundary.csv")
    folder = exported("below", "graph-csv", "--cut", "z=0.1")
    cells, walls = table(folder / "cells.csv"), table(folder / "boundary.csv")
    assert cells["z"].max() < 0.1
    assert (walls["normal_z"] > 0.5).sum() > (whole["normal_z"] > 0.5).sum() / 2
    outward = np.stack([walls[f"normal_{axis}"] for axis in "xyz"], axis=1)
    assert np.abs(walls["area"] @ outward).max() < 1e-10
    flux = walls["area"] * np.einsum("ij,ij->i", outward, places(walls))
    assert flux.sum() / 3 == pytest.approx(cells["volume"].sum(), rel=1e-10)


def test_contracted_edges_are_named(heart_run: Path, cli: Cli, tmp_path: Path) -> None:
    words = ["export", "graph", "--format", "graph-csv", "--run", heart_run]
    done = cli(*words, cwd=tmp_path)
    assert "degrees from perpendicular to the faces" in done.stdout
    assert "run: vorolight volume --sliver 0" in done.stdout
    again = cli(*words, cwd=tmp_path)
    assert again.returncode == 2
    assert "graph: exists; choose another name, or replace it with --force" in again.stderr
    (tmp_path / "graph" / "mine").write_text("kept")
    assert cli(*words, "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "graph" / "mine").read_text() == "kept"


@given(st.lists(st.floats(-1e90, 1e90), min_size=1))
def test_values_of_tough_have_ten_characters(values: list[float]) -> None:
    for value, text in zip(values, graph_files._fixed(np.array(values)), strict=True):
        assert len(text) == 10
        # Of a negative number with an exponent three digits follow the point.
        assert float(text) == pytest.approx(value, rel=6e-4, abs=1e-99)


def test_without_flopy_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flopy.mf6", None)
    empty = np.zeros((0, 3))
    graph = DualGraph(empty, empty[:, 0], np.zeros((0, 2), int), *[empty] * 6)
    with pytest.raises(BackendMissing, match=r"pip install 'vorolight\[modflow\]'"):
        disu.encode(graph)
