"""Point clouds: reading them, the surface they sample, and runs on them."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import Cli, fibonacci, sphere_mesh, torus_mesh, write_ply
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.errors import InputError
from vorolight.stages.inputs.points.gauss_reconstruction import Dipoles, Grid
from vorolight.stages.inputs.points.local_fits import Cloud
from vorolight.stages.inputs.points.noise import noise, outliers, spacings, typical
from vorolight.stages.inputs.points.reconstruction import Reconstruction, reconstruct
from vorolight.stages.inputs.points.source import PointSource
from vorolight.stages.inputs.resolve import identify, kind_of
from vorolight.stages.mesh.geometry import enclosed_volume, sample_triangles, triangle_areas
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology
from vorolight.stages.training.losses.shape import Chamfer, for_source


def shell(count: int, noise: float, seed: int = 0) -> np.ndarray:
    """Points about the unit sphere, at random, and off it by ``noise``."""
    random = np.random.default_rng(seed)
    points = random.standard_normal((count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points + noise * random.standard_normal((count, 3))


def torus_points(count: int) -> np.ndarray:
    vertices, triangles = torus_mesh(1.0, 0.35, 96, 48)
    return sample_triangles(vertices, triangles, count, np.random.default_rng(0))[0]


def facts(found: Reconstruction) -> tuple[int, int, int]:
    """Euler number, components and bad edges."""
    seen = topology(PolygonMesh.of_triangles(found.vertices, found.triangles))
    return seen.euler_number, seen.components, seen.bad_edges


def test_a_sphere_comes_back() -> None:
    centre = np.array([5.0, -3.0, 1.0])
    found = reconstruct(centre + fibonacci(4000, 2.0), None, None, 2)
    radius = np.linalg.norm(found.vertices - centre, axis=1)
    assert facts(found) == (2, 1, 0)
    # The quadrics leave out the fourth order: (window / radius)^4 is some 1e-5.
    assert np.abs(radius - 2).max() < 0.004
    volume = enclosed_volume(found.vertices, found.triangles)
    assert volume == pytest.approx(4 / 3 * np.pi * 8, rel=2e-3)  # and so outward
    assert found.noise < 0.004
    assert found.missed == 0
    assert found.kept.all()
    assert found.spacing == pytest.approx(2 * np.sqrt(4 * np.pi / 4000), rel=0.1)


@pytest.mark.parametrize("level", [0.01, 0.03, 0.06])
def test_noise_is_found_and_averaged(level: float) -> None:
    found = reconstruct(shell(20_000, level), None, None, 2)
    radius = np.linalg.norm(found.vertices, axis=1)
    assert facts(found) == (2, 1, 0)
    assert found.noise == pytest.approx(level, rel=0.15)
    # An average of the distances would be out by level^2, the centre of mass of a window inside.
    assert abs(radius.mean() - 1) < 0.15 * level
    # A window of 1.2 deviations holds 14 points where there are fewest: 1 / sqrt(14) and a half.
    assert radius.std() < 0.45 * level


def test_given_noise_is_taken() -> None:
    found = reconstruct(shell(5000, 0.03), None, 0.05, 2)
    assert found.noise == pytest.approx(0.05)


def test_a_torus_keeps_its_hole() -> None:
    found = reconstruct(torus_points(6000), None, None, 2)
    assert facts(found) == (0, 1, 0)
    area = float(triangle_areas(found.vertices, found.triangles).sum())
    assert area == pytest.approx(4 * np.pi**2 * 0.35, rel=0.01)


def test_two_spheres_are_two_components() -> None:
    points = np.concatenate([fibonacci(3000), fibonacci(1000, 0.5) + np.array([3, 0, 0])])
    assert facts(reconstruct(points, None, None, 2)) == (4, 2, 0)


def test_a_small_piece_stays_if_points_hold_it() -> None:
    """Less than a hundredth of the volume."""
    points = np.concatenate([fibonacci(8000), fibonacci(400, 0.2) + np.array([1.6, 0, 0])])
    assert facts(reconstruct(points, None, None, 2)) == (4, 2, 0)


def test_a_cavity_stays() -> None:
    points = np.concatenate([fibonacci(6000), fibonacci(2500, 0.5)])
    found = reconstruct(points, None, None, 2)
    assert facts(found) == (4, 2, 0)
    volume = enclosed_volume(found.vertices, found.triangles)
    assert volume == pytest.approx(4 / 3 * np.pi * (1 - 0.125), rel=0.01)


def test_power_of_two_scales_change_no_bit() -> None:
    points = torus_points(3000)
    one = reconstruct(points, None, None, 2)
    small = reconstruct(points * 2.0**-20, None, None, 1)
    assert np.array_equal(one.vertices * 2.0**-20, small.vertices)
    assert np.array_equal(one.triangles, small.triangles)
    assert one.noise * 2.0**-20 == small.noise


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-6, 3.7, 1e5]))
def test_spacing_and_noise_go_with_the_scale(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    points = shell(3000, 0.02)
    moved = scale * (points @ turn.T)
    assert typical(spacings(moved)) == pytest.approx(scale * typical(spacings(points)), rel=1e-6)
    asked = np.random.default_rng(0), np.random.default_rng(0)
    assert noise(moved, asked[0]) == pytest.approx(scale * noise(points, asked[1]), rel=1e-4)


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_outliers_are_left_out(share: float) -> None:
    points = shell(6000, 0.0)
    random = np.random.default_rng(1)
    out = 4 * (random.random((int(share * 6000), 3)) - 0.5)
    out = out[np.abs(np.linalg.norm(out, axis=1) - 1) > 0.3]
    found = reconstruct(np.concatenate([points, out]), None, None, 2)
    assert facts(found) == (2, 1, 0)
    assert found.kept[:6000].mean() > 0.999
    assert found.kept[6000:].mean() < 0.15
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - 1).max() < 0.05


def test_a_noisy_cloud_has_no_outliers() -> None:
    assert outliers(shell(20_000, 0.03)).mean() < 1e-3


def test_holes_are_closed() -> None:
    points = fibonacci(8000)
    points = points[np.linalg.norm(points - [0, 0, 1], axis=1) > 0.4]
    found = reconstruct(points, None, None, 2)
    assert facts(found) == (2, 1, 0)
    # Anything between a flat lid, which cuts off 0.0066 of the ball, and the cap itself.
    volume = enclosed_volume(found.vertices, found.triangles) / (4 / 3 * np.pi)
    assert 0.985 < volume < 1.005


def test_uneven_density() -> None:
    random = np.random.default_rng(2)
    points = fibonacci(60_000)
    points = points[random.random(60_000) < 20.0 ** (-(1 + points[:, 0]) / 2)]
    found = reconstruct(points, None, None, 2)
    assert facts(found) == (2, 1, 0)
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - 1).max() < 0.02


def test_given_normals_are_checked() -> None:
    points = torus_points(5000)
    ring = points * [1, 1, 0]
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    normals = (points - ring) / 0.35
    true = reconstruct(points, normals, None, 2)
    turned = reconstruct(points, -7 * normals, None, 2)
    assert true.agreement is not None
    assert true.agreement > 0.99
    assert turned.agreement is not None
    assert turned.agreement > 0.99
    assert facts(true) == facts(turned) == (0, 1, 0)
    assert enclosed_volume(turned.vertices, turned.triangles) > 0
    random = np.random.default_rng(3)
    mixed = normals * np.where(random.random(5000) < 0.3, -1, 1)[:, None]
    for wrong in (mixed, random.standard_normal((5000, 3)), np.zeros((5000, 3))):
        found = reconstruct(points, wrong, None, 2)
        assert found.agreement is not None
        assert found.agreement < 0.9
        assert facts(found) == (0, 1, 0)


def test_dipoles_of_a_sphere_have_its_winding_number() -> None:
    points = fibonacci(6000)
    grid = Grid.around(points, 1 / 16, 2)
    area = np.full(6000, 4 * np.pi / 6000)
    dipoles = Dipoles(grid, points, area / grid.spacing**3, 0.0)
    potential = dipoles.potential(points.astype(np.float32))
    asked = np.array([[0, 0, 0], [0.6, 0, 0], [0, 1.2, 0], [-0.8, -0.8, 0.6]])
    at, _ = grid.interpolation(asked)
    # The box, whose border is at zero, is not infinite, but there the potential is zero anyway.
    assert np.allclose(at @ potential.reshape(-1), [1, 1, 0, 0], atol=0.02)
    assert np.median(dipoles.values(potential)) == pytest.approx(0.5, abs=0.03)
    least = dipoles.least()
    assert float((at @ least.reshape(-1))[:2].min()) > 0.7
    assert float((at @ least.reshape(-1))[2:].max()) < 0.3
    found = dipoles.gradient(least)
    along = -np.einsum("ij,ij->i", found, points) / np.linalg.norm(found, axis=1)
    assert along.min() > 0.9


def test_fits_of_a_sphere_bend_as_it_does() -> None:
    points = fibonacci(20_000, 2.0)
    fits = Cloud(points, points / 2, np.ones(len(points)), 2).fits(
        1.01 * points[::100], points[::100] / 2, 0.0, np.full(200, 0.05)
    )
    assert np.allclose(fits.height, -0.02, atol=5e-4)
    # Half the Laplacian of the height is minus the mean curvature, held back by a hundredth or so.
    assert np.allclose(fits.bend, -0.5, atol=0.03)
    assert fits.residual.max() < 1e-3


def test_points_without_an_inside_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.random.default_rng(0).random((150, 2)))
    with pytest.raises(InputError, match="rows of x, y, z"):
        _ = PointSource(tmp_path / "a.npz").cloud


def test_what_classify_stored_is_restored(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", shell(3000, 0.02))
    first = PointSource(tmp_path / "a.npy")
    stored = first.state()
    again = identify(str(tmp_path / "a.npy")).open(stored)
    assert again.describe() == first.describe()
    assert again.warnings() == first.warnings()
    at = np.random.default_rng(0).random((500, 3)) * 3 - 1.5
    assert np.array_equal(again.inside(at), first.inside(at))
    assert np.array_equal(first.inside(at), np.linalg.norm(at, axis=1) < 1) or (
        (first.inside(at) != (np.linalg.norm(at, axis=1) < 1)).mean() < 0.01
    )


def test_kinds_are_recognised(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "mesh.ply", *sphere_mesh())
    assert kind_of(mesh) == "mesh"
    np.save(tmp_path / "grid.npy", np.zeros((5, 5, 5)))
    assert kind_of(tmp_path / "grid.npy") == "field"
    assert identify(str(mesh), "points").open().describe()["points"] == 642
    np.savez(tmp_path / "a.npz", points=fibonacci(200))
    source = identify(str(tmp_path / "a.npz"), "field").open()
    with pytest.raises(InputError, match="'values'"):
        source.bounding_box()


def test_a_run_on_points(tmp_path: Path, cli: Cli) -> None:
    """From a text file to a certified surface, with the stages called one by one."""
    import trimesh

    np.savetxt(tmp_path / "ball.xyz", shell(5000, 0.01))
    done = cli("classify", "ball.xyz", "-n", 8, "--preview", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "ball.vorolight"
    stored = json.loads((folder / "classify.json").read_text())
    assert stored["metrics"]["input"]["noise"] == pytest.approx(0.01, rel=0.2)
    assert (folder / "classify.png").read_bytes().startswith(b"\x89PNG")
    for stage in ("init", "sphere-train", "evaluate"):
        done = cli(stage, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    metrics = json.loads((folder / "sphere-train.json").read_text())["metrics"]
    assert metrics["certificate"]["holds"]
    mesh = trimesh.load(folder / "sphere-train.ply", process=False)
    assert mesh.is_watertight
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02
    measured = json.loads((folder / "evaluate-sphere-train.json").read_text())["metrics"]
    assert measured["chamfer"]["f1"] > 0.8  # of points with a noise of a third of the threshold
    again = cli("classify", "ball.xyz", "-n", 8, "--noise", 0.02, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    stored = json.loads((folder / "classify.json").read_text())
    assert stored["metrics"]["input"]["noise"] == pytest.approx(0.02)
    assert stored["metrics"]["input"]["noise_given"]


def test_options_that_do_not_fit(tmp_path: Path, cli: Cli) -> None:
    for words, said in (
        (["sphere", "--noise", 0.1], "--noise: needs a point cloud"),
        (["sphere", "--kind", "mesh"], "no such file"),
        (["sphere", "--kind", "cloud"], "must be one of mesh, points, field"),
        (["--kind", "mesh"], "give an INPUT"),
    ):
        done = cli("classify", *words, cwd=tmp_path)
        assert done.returncode in (2, 3), done.stderr
        assert said in done.stderr
        assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_too_much_noise_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", fibonacci(500))
    source = PointSource(tmp_path / "a.npy")
    source.given_noise = 1.0
    with pytest.raises(InputError, match=r"a\.npy: a noise of 1 is too large"):
        source.bounding_box()


@pytest.mark.parametrize(("level", "robust"), [(0.0, False), (0.03, True)])
def test_chamfer_targets_of_noisy_points_are_on_the_surface(
    tmp_path: Path, level: float, robust: bool
) -> None:
    np.save(tmp_path / "a.npy", shell(4000, level))
    source = PointSource(tmp_path / "a.npy")
    frame = ModelFrame(np.zeros(3), 0.2)
    context = SimpleNamespace(
        source=lambda: source,
        surface=source.true_surface(frame, 2),
        params=SimpleNamespace(target_samples=1000),
        random=lambda purpose: np.random.default_rng(0),
        threads=2,
    )
    loss = for_source(context, frame, "paper")  # type: ignore[arg-type]
    assert isinstance(loss, Chamfer)
    away = np.abs(0.2 * np.linalg.norm(loss.target.numpy(), axis=1) - 1)
    assert away.std() < 0.012
    assert len(away) == 1000
    given = np.abs(
        np.linalg.norm(source.surface_samples(1000, np.random.default_rng(0)), axis=1) - 1
    )
    assert (away.mean() < 0.6 * given.mean()) == robust
