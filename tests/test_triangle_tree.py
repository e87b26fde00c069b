"""Closest points and rays, compared with all triangles one by one."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import random_rotation, sphere_mesh
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages.mesh.queries.triangle_tree import TriangleTree


def soup(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles, some of them needles and some without area."""
    random = np.random.default_rng(seed)
    corners = random.random((count, 1, 3)) + 0.3 * random.normal(size=(count, 3, 3))
    corners[::7, 2] = 0.5 * (corners[::7, 0] + corners[::7, 1])
    corners[1::7, 2] = corners[1::7, 0] + 1e-6 * random.normal(size=corners[1::7, 0].shape)
    corners[2::11] = corners[2::11, :1]
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def sampled(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Points ``(T, S, 3)`` of a fine grid on every triangle."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(0, 1, 41)] * 2))
    kept = u + v <= 1 + 1e-12
    weights = np.stack([1 - u - v, u, v], axis=1)[kept]
    return np.einsum("sk,tkd->tsd", weights, vertices[triangles])


@given(st.integers(0, 10**6), st.sampled_from([1, 2, 5, 40, 333]))
def test_no_point_of_any_triangle_is_closer(seed: int, count: int) -> None:
    vertices, triangles = soup(seed, count)
    points = np.random.default_rng(seed + 1).normal(size=(30, 3))
    square, number, place = TriangleTree(vertices, triangles).closest(points)
    assert np.allclose(((place - points) ** 2).sum(axis=1), square, atol=1e-12)
    grid = sampled(vertices, triangles)
    every = np.linalg.norm(grid[None] - points[:, None, None], axis=-1)
    assert (np.sqrt(square) <= every.min(axis=(1, 2)) + 1e-9).all()
    # The place lies on the triangle that is named: no further from its grid than its spacing.
    off = np.linalg.norm(grid[number] - place[:, None], axis=-1).min(axis=1)
    longest = np.linalg.norm(np.ptp(vertices[triangles[number]], axis=1), axis=1)
    assert (off <= longest / 40).all()


def test_distances_of_a_ball_are_those_of_its_facets() -> None:
    vertices, triangles = sphere_mesh(1.0, 4)
    tree = TriangleTree(vertices, triangles, threads=2)
    points = 3 * np.random.default_rng(0).normal(size=(20_000, 3))
    far = np.linalg.norm(points, axis=1)
    square, _, _ = tree.closest(points)
    # Facets of such a ball are nowhere more than 0.002 from it.
    assert np.abs(np.sqrt(square) - np.abs(far - 1)).max() < 2e-3
    alone = TriangleTree(vertices, triangles).closest(points)
    for one, other in zip(tree.closest(points), alone, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("seed", range(5))
def test_a_ray_meets_the_first_triangle(seed: int) -> None:
    vertices, triangles = soup(seed, 60)
    random = np.random.default_rng(seed)
    points = random.normal(size=(300, 3))
    directions = random.normal(size=(300, 3))
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach, number = TriangleTree(vertices, triangles).first_met(points, directions)
    expected = np.full(300, np.inf)
    for a, b, c in vertices[triangles]:
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) < 1e-9:
            continue
        far = ((a - points) @ normal) / (directions @ normal)
        at = points + far[:, None] * directions
        within = np.stack(
            [np.cross(q - p, at - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
        ).min(axis=0)
        expected = np.where((far > 0) & (within >= 0) & (far < expected), far, expected)
    assert np.allclose(reach, expected, rtol=1e-6)
    assert ((number < 0) == np.isinf(expected)).all()


@given(st.integers(0, 10**6))
def test_no_ray_passes_between_two_triangles(seed: int) -> None:
    vertices, triangles = sphere_mesh(1.0, 3)
    vertices = vertices @ random_rotation(seed).T
    # Through edges and vertices, from within.
    ways = np.concatenate([vertices, vertices[triangles[:, 0]] + vertices[triangles[:, 1]]])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    reach, _ = TriangleTree(vertices, triangles).first_met(np.zeros_like(ways), ways)
    assert np.isfinite(reach).all()
    assert (np.abs(reach - 1) < 0.02).all()
