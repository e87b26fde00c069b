"""Fields given by samples on a grid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import QUICK, Cli

from vorolight.stages.errors import InputError
from vorolight.stages.sources.fields import FieldSource
from vorolight.stages.sources.grid import load


def ellipsoid(path: Path, count: int = 24) -> Path:
    """``x^2 + y^2 + (z/2)^2 - 1`` about (5, 0, 0), sampled with other steps along each axis."""
    steps = np.array([2.6, 2.8, 4.8]) / (count - 1)
    origin = np.array([5 - 1.3, -1.4, -2.4])
    x, y, z = (origin[k] + steps[k] * np.arange(count) for k in range(3))
    x, y, z = np.meshgrid(x, y, z, indexing="ij")
    values = (x - 5) ** 2 + y**2 + (z / 2) ** 2 - 1
    np.savez(path, values=values.astype(np.float32), origin=origin, spacing=steps)
    return path


def test_samples_are_interpolated_with_their_gradient(tmp_path: Path) -> None:
    source = FieldSource("e", path=ellipsoid(tmp_path / "e.npz"))
    field = source.field.formula
    low, high = source.bounding_box()
    assert np.allclose([low, high], [[3.7, -1.4, -2.4], [6.3, 1.4, 2.4]])
    points = low + 0.2 + np.random.default_rng(0).random((500, 3)) * (high - low - 0.4)
    x, y, z = (points - [5, 0, 0]).T
    # Of a quadratic only the reflection at the border is wrong, which fades by a factor of four a
    # sample; the samples are rounded to 1e-7.
    value, slope = source.gradient(points)
    assert np.allclose(value, x**2 + y**2 + z**2 / 4 - 1, atol=0.02)
    middle = np.abs(points - [5, 0, 0]).max(axis=1) < 0.5
    assert np.allclose(value[middle], (x**2 + y**2 + z**2 / 4 - 1)[middle], atol=1e-5)
    step = 1e-5
    for axis in range(3):
        ahead, behind = (points + sign * step * np.eye(3)[axis] for sign in (1, -1))
        numeric = (field(*ahead.T, np) - field(*behind.T, np)) / (2 * step)
        # Second derivatives are continuous: central differences are off by their square.
        assert np.allclose(slope[:, axis], numeric, atol=1e-6)
    samples = source.surface_samples(2000, np.random.default_rng(0))
    assert np.abs(source.value(samples)).max() < 1e-9
    far = np.array([[100.0, 0, 0], [5, 9, 9]])
    assert (source.value(far) > 1).all()
    assert not source.inside(far).any()
    at = torch.tensor(points)
    assert np.allclose(source.level(at).numpy(), value)


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load(path)


def test_files_that_hold_no_field(tmp_path: Path) -> None:
    inside = np.ones((6, 6, 6))
    inside[2:4, 2:4, 2:4] = -1
    for name, array, words in (
        ("flat", np.ones((5, 5)), "three dimensions"),
        ("thin", np.ones((5, 5, 3)), "three dimensions"),
        ("positive", np.ones((5, 5, 5)), "no sample is negative"),
        ("cut", -inside, "negative at the border"),
        ("nan", np.where(inside < 0, np.nan, inside), "8 samples are not finite"),
        ("text", np.full((5, 5, 5), "a"), "not numbers"),
        ("objects", np.full((5, 5, 5), None), "not a readable array"),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        refused(tmp_path / f"{name}.npy", words)
    np.savez(tmp_path / "other.npz", field=inside)
    refused(tmp_path / "other.npz", "no array called 'values'")
    np.savez(tmp_path / "steps.npz", values=inside, spacing=[1, -1, 1])
    refused(tmp_path / "steps.npz", "'spacing' positive")
    np.savez(tmp_path / "origin.npz", values=inside, origin=[1, 1])
    refused(tmp_path / "origin.npz", "three numbers")
    np.save(tmp_path / "whole.npy", inside)
    whole = (tmp_path / "whole.npy").read_bytes()
    for size in (0, 5, 40, 200, len(whole) - 1):
        (tmp_path / "part.npy").write_bytes(whole[:size])
        refused(tmp_path / "part.npy", "not a readable array")
    # A header that promises more than there is.
    (tmp_path / "part.npy").write_bytes(whole.replace(b"(6, 6, 6)", b"(9999,9999,9999)", 1))
    refused(tmp_path / "part.npy", "not a readable array")
    (tmp_path / "part.npz").write_bytes(b"PK" + whole)
    refused(tmp_path / "part.npz", "not a readable array")


def test_a_run_of_samples(tmp_path: Path, cli: Cli) -> None:
    ellipsoid(tmp_path / "egg.npz")
    done = cli("run", "egg.npz", "-n", 10, "--until", "evaluate", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "egg.vorolight" / "evaluate-sphere-train.json").read_text())
    assert found["metrics"]["topology"]["euler_number"] == 2
    # Triangles of a coarse surface lie inside the ellipsoid.
    assert found["metrics"]["volume"] == pytest.approx(8 / 3 * np.pi, rel=0.06)
    done = cli("status", "egg.npz", cwd=tmp_path)
    assert "stale" not in done.stdout
    np.save(tmp_path / "points.npy", np.zeros((50, 3)))
    done = cli("classify", "points.npy", cwd=tmp_path)
    assert done.returncode == 3
    assert "points.npy: holds samples of shape (50, 3)" in done.stderr
