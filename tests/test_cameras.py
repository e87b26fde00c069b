"""Cameras: projection, derivatives, rays."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import CAMERA_MATRIX, camera

from vorolight.stages.render.cameras import looking, rigid


@pytest.mark.parametrize("orthographic", [False, True])
def test_a_camera_projects_moves_and_differentiates(orthographic: bool) -> None:
    here = camera(3, orthographic)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    projected = here.project(points)
    placed = points @ here.rotation.T + here.translation
    depth = 1.0 if orthographic else placed[:, 2:]
    flat = placed / depth
    flat[:, 2] = 1
    np.testing.assert_allclose(projected[:, :2], (flat @ here.matrix.T)[:, :2], atol=1e-9)
    h = 1e-6
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (here.project(points + step) - here.project(points - step))[:, :2] / (2 * h)
        np.testing.assert_allclose(here.jacobian(points)[:, :, axis], slope, atol=1e-5)
    origin, spacing = np.array([0.3, 0.2, -0.1]), 0.07
    moved = here.in_frame(origin, spacing)
    again = moved.project((points - origin) / spacing)
    np.testing.assert_allclose(again[:, :2], projected[:, :2], atol=1e-8)
    small = here.shrunk(2).project(points)
    np.testing.assert_allclose(small[:, :2], projected[:, :2] / 2, atol=1e-9)
    # The point that a pixel shows lies on its ray.
    ray = here.rays(projected[:, :2])
    if not orthographic:
        way = points - here.position
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        np.testing.assert_allclose(way, ray, atol=1e-9)
    on = here.project(points + 0.1 * ray)
    np.testing.assert_allclose(on[:, :2], projected[:, :2], atol=1e-8)
    assert (on[:, 2] < projected[:, 2]).all()


def test_a_camera_that_looks_has_its_axis_through_the_target() -> None:
    for up in (np.array([0.0, 0, 1]), np.array([1.0, 2, -0.5])):  # the first is along the view
        here = looking(np.array([0.0, 0, 5]), np.zeros(3), up, CAMERA_MATRIX, 64, False)
        assert rigid(here.rotation)
        np.testing.assert_allclose(here.position, [0, 0, 5], atol=1e-12)
        np.testing.assert_allclose(here.project(np.zeros((1, 3)))[0, :2], CAMERA_MATRIX[:2, 2])
