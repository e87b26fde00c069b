"""Losses: known values, and gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import sphere_mesh

from vorolight.stages.inputs.field.source import FieldSource
from vorolight.stages.mesh.frames import Connectivity, face_frames
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.spheres import initial_spheres, near_pairs
from vorolight.stages.progress import Silent
from vorolight.stages.solvers.adam import Schedule, adam
from vorolight.stages.training import paper
from vorolight.stages.training.losses import regularization, shape, sphere

MESH = PolygonMesh.of_triangles(*sphere_mesh(1.0, 1))
FRAME = ModelFrame(np.array([0.1, -0.2, 0.3]), 0.25)


def noisy() -> torch.Tensor:
    shift = 0.05 * np.random.default_rng(0).normal(size=MESH.vertices.shape)
    return torch.tensor(MESH.vertices + shift, requires_grad=True)


@pytest.mark.parametrize("name", ["normal_consistency", "area_uniformity", "centroid_alignment"])
def test_regularisers(name: str) -> None:
    connectivity = Connectivity.of(MESH)

    def loss(vertices: torch.Tensor) -> torch.Tensor:
        frames = face_frames(vertices, connectivity)
        if name == "area_uniformity":
            return regularization.area_uniformity(frames)
        return getattr(regularization, name)(frames, connectivity)

    assert torch.autograd.gradcheck(loss, noisy())
    ideal = PolygonMesh.of_triangles(*sphere_mesh(1.0, 0))
    vertices = torch.tensor(ideal.vertices)
    connectivity = Connectivity.of(ideal)
    if name == "area_uniformity":
        assert float(loss(vertices)) == pytest.approx(0, abs=1e-20)


def test_normal_consistency_of_a_plane_is_zero_and_of_a_fold_is_not() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    mesh = PolygonMesh.of_triangles(vertices, np.array([[0, 1, 2], [2, 1, 3]]))
    connectivity = Connectivity.of(mesh)
    flat = regularization.normal_consistency(
        face_frames(torch.tensor(vertices), connectivity), connectivity
    )
    assert float(flat) == pytest.approx(0, abs=1e-20)
    vertices[3, 2] = 1
    bent = regularization.normal_consistency(
        face_frames(torch.tensor(vertices), connectivity), connectivity
    )
    n1, n2 = np.array([0, 0, 1]), np.array([-1, -1, 1]) / np.sqrt(3)
    assert float(bent) == pytest.approx((1 - n1 @ n2) ** 2)


def test_sphere_losses() -> None:
    centres = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    radii = torch.full((3,), np.sqrt(2), dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.int64)
    outer, inner = sphere.targets(
        torch.zeros(1, 3, dtype=torch.float64),
        torch.tensor([[0.0, 0, 1]], dtype=torch.float64),
        torch.ones(1, dtype=torch.float64),
    )
    exact = sphere.intersection(outer, inner, centres, radii, zero, torch.arange(3))
    assert float(exact) == pytest.approx(0, abs=1e-30)
    wide = sphere.intersection(outer, inner, centres, 2 * radii, zero, torch.arange(3))
    assert float(wide) == pytest.approx(36)  # power 2 - 8 for every sphere and target
    points = torch.cat([outer, inner])
    pairs = torch.tensor([0, 1]), torch.tensor([0, 1])
    assert float(sphere.exclusion(points, centres, 0.5 * radii, *pairs)) == 0
    inside = sphere.exclusion(points, centres, 2 * radii, *pairs)
    assert float(inside) == pytest.approx(36)


def test_sphere_gradients() -> None:
    random = np.random.default_rng(3)
    connectivity = Connectivity.of(MESH)
    radii = torch.tensor(0.6 + 0.1 * random.random(MESH.vertex_count), requires_grad=True)
    offsets = torch.tensor(0.5 + 0.1 * random.random(MESH.face_count), requires_grad=True)
    pairs = (
        torch.tensor(random.integers(0, 2 * MESH.face_count, 200)),
        torch.tensor(random.integers(0, MESH.vertex_count, 200)),
    )

    def loss(c: torch.Tensor, r: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        frames = face_frames(c, connectivity)
        outer, inner = sphere.targets(frames.centroid, frames.normal, d)
        return sphere.intersection(
            outer, inner, c, r, connectivity.corner_faces, connectivity.corners
        ) + sphere.exclusion(torch.cat([outer, inner]), c, r, *pairs)

    assert torch.autograd.gradcheck(loss, (noisy(), radii, offsets))


def test_level_set_is_in_units_of_the_spacing() -> None:
    source = FieldSource("sphere")
    points = torch.tensor([[1.2, 0, 0], [0, 0.9, 0]], dtype=torch.float64)
    model = torch.tensor(FRAME.model_from_input(points.numpy()), requires_grad=True)
    loss = shape.level_set(source.level, FRAME)
    assert float(loss(model, True).detach()) == pytest.approx((0.2**2 + 0.1**2) / 2 / 0.25**2)
    assert torch.autograd.gradcheck(lambda x: loss(x, True), model)


def test_first_order_distance_of_a_scaled_field_is_the_distance() -> None:
    source = FieldSource("sphere")
    model = torch.tensor(FRAME.model_from_input(np.array([[1.2, 0, 0], [0, 0.9, 0]])))
    model.requires_grad_(True)
    plain = shape.first_order_distance(source.level, FRAME)(model, True)
    steep = shape.first_order_distance(lambda x: 50 * source.level(x), FRAME)(model, True)
    assert float(plain.detach()) == pytest.approx((0.2**2 + 0.1**2) / 2 / 0.25**2)
    assert float(steep.detach()) == pytest.approx(float(plain.detach()))
    # Where |grad F| is constant the gradient is that of the level-set loss.
    level = shape.level_set(source.level, FRAME)(model, True)
    ours, theirs = (torch.autograd.grad(loss, model)[0] for loss in (plain, level))
    assert torch.allclose(ours, theirs)
    assert torch.allclose(torch.autograd.grad(steep, model)[0], theirs)


def test_chamfer() -> None:
    target = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.0]])
    loss = shape.Chamfer(target, 1)
    samples = torch.tensor([[0.1, 0, 0], [0, 2.2, 0.0]], requires_grad=True)
    samples = samples.double().detach().requires_grad_(True)
    forward, backward = (0.01 + 0.04) / 2, (0.01 + 0.81 + 0.04) / 3
    assert float(loss(samples, True).detach()) == pytest.approx(forward + backward)
    assert torch.autograd.gradcheck(lambda x: loss(x, True), samples)


class Nowhere:
    """Checkpoints that are not kept."""

    def latest(self) -> None:
        return None

    def save(self, iteration: int, arrays: dict) -> None:
        pass


@pytest.mark.parametrize("patience", [None, 10])
def test_training_ends_where_nothing_is_won(patience: int | None) -> None:
    place = torch.tensor([3.0], dtype=torch.float64, requires_grad=True)
    history = adam(
        {"place": place},
        lambda iteration: {"square": (place**2).sum() + 1},
        {"square": 1.0},
        Schedule(400, 0.2, "constant", 1000, patience),
        Nowhere(),
        Silent(),
        "test",
    )
    assert abs(float(place.detach())) < 1  # overshooting, Adam comes back slowly
    assert len(history) == 400 if patience is None else 20 < len(history) < 200


def test_a_radius_that_steps_through_zero_is_positive(monkeypatch: pytest.MonkeyPatch) -> None:
    """The losses depend on its square, and its sphere is searched for intruders all the same."""
    radii, offsets = initial_spheres(MESH)
    radii[0] *= -1
    monkeypatch.setattr(paper, "initial_spheres", lambda mesh: (radii, offsets))
    searched = []

    def near(*asked: object) -> tuple[np.ndarray, np.ndarray]:
        searched.append(asked[3])
        return near_pairs(*asked)

    monkeypatch.setattr(paper, "near_pairs", near)
    weights = dict.fromkeys(("intersection", "exclusion", "shape", "normal"), 1.0)
    loss = shape.level_set(FieldSource("sphere").level, FRAME)
    schedule = Schedule(2, 1e-3, "constant", 100)
    found = paper.train(MESH, loss, weights, schedule, Nowhere(), Silent(), "cpu", 1)
    assert (found[1] > 0).all()
    assert (searched[0] == np.abs(radii)).all()
