"""The one call from Python: shapes as paths and objects, results as objects, progress, stopping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli, sphere_mesh

from vorolight.stages.errors import ArtifactError, Stopped, UsageError
from vorolight.stages.run import Run, run

QUICK: dict[str, Any] = {
    "init": {"iterations": 15}, "sphere_train": {"iterations": 20}, "volume": {"inner": 20,
    "cvt_iterations": 5},
}  # fmt: skip


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(
        sphere_mesh(1.0, 3), n=8, until="volume", threads=1,
        folder=tmp_path_factory.mktemp("python") / "ball", **QUICK,
    )  # fmt: skip


def test_a_run_gives_objects(ball: Run) -> None:
    assert ball.metrics["sphere-train"]["certificate"]["holds"]
    mesh = ball.trimesh()
    assert mesh.is_watertight
    # Of a ball of radius 1; the vertices of a surface with edges of 0.25 lie on it.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.03)
    inside, outside = ball.generators
    assert (np.linalg.norm(inside, axis=1) < np.linalg.norm(outside, axis=1)).all()
    # A face is as far from either of its generators.
    corner = ball.surface.vertices[ball.surface.face_vertices[ball.surface.face_offsets[:-1]]]
    arms = [np.linalg.norm(corner - points, axis=1) for points in (inside, outside)]
    assert np.abs(arms[0] - arms[1]).max() < 1e-9
    # Every generator of a face lies on the spheres of its corners.
    trained = ball.trained
    face, corner = trained.polygons.corner_faces, trained.polygons.face_vertices
    arm = trained.inside[face] - trained.polygons.vertices[corner]
    assert np.abs(np.linalg.norm(arm, axis=1) - trained.radii[corner]).max() < 1e-9
    assert ball.cells.cell_count == ball.metrics["volume"]["cells"]
    assert ball.graph.inner == (ball.cells.neighbour >= 0).sum()
    assert ball.graph.volume.sum() == ball.metrics["volume"]["cell_volume_sum"]
    assert set(ball.warnings) == {"classify", "init", "sphere-train", "volume"}


def test_it_leaves_the_bytes_of_the_command_line(ball: Run, tmp_path: Path, cli: Cli) -> None:
    """The input has the name that it has in the run folder."""
    (tmp_path / "ball").mkdir()
    (tmp_path / "ball" / "input.ply").write_bytes((ball.folder / "input.ply").read_bytes())
    done = cli(
        "run", "ball/input.ply", "--run", "ball", "-n", 8, "--until", "volume", "--threads", 1,
        "--init-iterations", 15, "--sphere-train-iterations", 20, "--inner", 20,
        "--cvt-iterations", 5, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for name in ("classify.h5", "init.h5", "sphere-train.ply", "sphere-train.h5", "volume.h5"):
        assert (tmp_path / "ball" / name).read_bytes() == (ball.folder / name).read_bytes(), name


def test_nothing_runs_twice(ball: Run) -> None:
    seen: list[str] = []
    again = run(
        sphere_mesh(1.0, 3), n=8, until="volume", threads=1, folder=ball.folder,
        progress=lambda stage, doing, share: seen.append(stage), **QUICK,
    )  # fmt: skip
    assert seen == []
    assert np.array_equal(again.surface.vertices, ball.surface.vertices)


def test_a_run_is_stopped_and_goes_on(tmp_path: Path) -> None:
    def until_init(stage: str, doing: str, share: float) -> bool:
        assert 0 <= share <= 1
        return stage != "init"

    with pytest.raises(Stopped):
        run("sphere", n=6, until="init", folder=tmp_path / "ball", progress=until_init)
    assert list(Run(tmp_path / "ball").manifests) == ["classify"]
    with pytest.raises(ArtifactError, match="no stage with a surface"):
        Run(tmp_path / "ball").surface  # noqa: B018
    done = run("sphere", n=6, until="init", folder=tmp_path / "ball", init={"iterations": 10})
    assert done.surface.face_count > 100


def test_what_other_libraries_have_is_taken(tmp_path: Path) -> None:
    import trimesh
    from vtkmodules.vtkFiltersSources import vtkCubeSource

    box = vtkCubeSource()
    box.Update()
    shapes = {
        "trimesh": trimesh.creation.icosphere(2),
        "vtk": box.GetOutput(),
        "points": np.asarray(trimesh.creation.icosphere(4).vertices),
        "samples": np.linalg.norm(np.indices((9, 9, 9)) - 4.0, axis=0) - 2.5,
    }
    kinds = {}
    for name, shape in shapes.items():
        done = run(shape, n=6, until="classify", folder=tmp_path / name)
        kinds[name] = done.manifests["classify"]["inputs"][0]["kind"]
    assert kinds == {"trimesh": "mesh", "vtk": "mesh", "points": "points", "samples": "field"}


def test_a_folder_of_its_own_goes_with_the_result() -> None:
    done = run(sphere_mesh(), n=6, until="classify")
    folder = done.folder
    assert (folder / "classify.json").is_file()
    del done
    assert not folder.exists()


@pytest.mark.parametrize(
    ("shape", "options", "words"),
    [
        ("sphere", {"until": "print"}, "must be one of classify"),
        ("sphere", {"train": {}}, "train: is not a stage of this run"),
        ("sphere", {"init": {"steps": 3}}, "steps is not one of its options: "),
        ("sphere", {"volume": {}}, "volume: is not a stage of this run"),
        ((np.zeros((3, 3)), np.array([[0, 1, 3]])), {}, "numbers of vertices"),
        ((np.zeros((3, 2)), np.array([[0, 1, 2]])), {}, "vertices (V, 3)"),
        ([1, 2, 3], {}, "a list is not a path"),
    ],
)
def test_what_does_not_fit_is_refused(
    shape: Any, options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as error:
        run(shape, folder=tmp_path / "new", **options)
    assert words in str(error.value)
    assert not (tmp_path / "new").exists()
