"""Formulas as fields: what they are worth, what is refused, and where the shape is looked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import QUICK, Cli
from hypothesis import given
from hypothesis import strategies as st

from vorolight.stages import torch_start
from vorolight.stages.errors import InputError
from vorolight.stages.inputs.field.expression import ONE, parse
from vorolight.stages.inputs.field.source import FieldSource


def test_a_formula_is_worth_what_it_says_and_its_gradient_is_exact() -> None:
    text = "-x**2/3 + max(sin(y), 0.2, z) * exp(-abs(z)) - sqrt(2)**3 + pi*x*y**-1 + tanh(x + 1)"
    formula = parse(text)
    points = np.random.default_rng(0).uniform(0.3, 1.2, (50, 3))
    x, y, z = points.T
    expected = -(x**2) / 3 + np.maximum(np.maximum(np.sin(y), 0.2), z) * np.exp(-np.abs(z))
    expected += -(np.sqrt(2) ** 3) + np.pi * x / y + np.tanh(x + 1)
    assert np.allclose(formula(x, y, z, np), expected, rtol=1e-14)
    at = torch.tensor(points, requires_grad=True)
    value = formula(*at.unbind(1), torch)
    assert np.allclose(value.detach().numpy(), expected, rtol=1e-14)
    (slope,) = torch.autograd.grad(value.sum(), at)
    step = 1e-6
    for axis in range(3):
        ahead, behind = (points + sign * step * np.eye(3)[axis] for sign in (1, -1))
        numeric = (formula(*ahead.T, np) - formula(*behind.T, np)) / (2 * step)
        # Central differences: 1e-12 of the third derivative, and rounding over the step.
        assert np.allclose(slope[:, axis].numpy(), numeric, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x.__class__", "not allowed"),
        ("__import__('os').system('true') + x", "not allowed"),
        ("().__class__ * x", "not allowed"),
        ("open(x)", "no function open"),
        ("max(x, y, key=z)", "not allowed"),
        ("max(*x)", "not allowed"),
        ("(lambda: x)()", "not allowed"),
        ("[x for x in y]", "not allowed"),
        ("f'{x}'", "not allowed"),
        ("x if y else z", "not allowed"),
        ("x := 3", "not a formula"),
        ("x; y", "not a formula"),
        ("True * x", "not allowed"),
        ("x ** (9**9**9)", "exponents"),
        ("x ** y", "exponents"),
        ("x ** 1e3", "exponents"),
        ("1" + "0" * 400 + " * x", "too large"),
        ("x ^ 2", "write powers as a**b"),
        ("x // 2", "not allowed"),
        ("sqrt(x, y)", "one argument"),
        ("max(x)", "two or more"),
        ("1 + 2", "none of x, y and z"),
        ("-" * 300 + "x", "nested deeper"),
        ("(" * 300 + "x" + ")" * 300, "not a formula"),
        ("+x" * 3000, "6000 characters"),
        ("", "not a formula"),
        ("x\0", "not a formula"),
    ],
)
def test_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words.replace("*", r"\*").replace("^", r"\^")):
        parse(text)


@given(st.text(alphabet="xyz0189.+-*/()^,_ eqrtamin\"'[]{}:=@%", max_size=60))
def test_whatever_is_written_is_a_formula_or_refused(text: str) -> None:
    try:
        formula = parse(text)
    except InputError:
        return
    zeros = np.zeros(2)
    assert np.shape(formula(zeros, zeros, zeros, np)) in ((), (2,))


@pytest.mark.parametrize("scale", [1e-5, 1.0, 3e4])
def test_the_shape_is_found_at_any_scale(scale: float) -> None:
    source = FieldSource(f"(x/{scale})**2 + (y/{scale} - 1)**2 + 4*(z/{scale})**2 - 1")
    low, high = source.bounding_box() / scale
    truth = np.array([[-1, 0, -0.5], [1, 2, 0.5]])
    assert (low < truth[0]).all()
    assert (high > truth[1]).all()
    assert (high - low < 1.5 * np.array([2, 2, 1])).all()
    points = source.surface_samples(2000, np.random.default_rng(0)) / scale
    assert np.allclose(points[:, 0] ** 2 + (points[:, 1] - 1) ** 2 + 4 * points[:, 2] ** 2, 1)


def test_a_second_part_further_away_is_found() -> None:
    box = FieldSource("min(x**2 + y**2 + z**2 - 1, (x - 10)**2 + y**2 + z**2 - 1)").bounding_box()
    assert box[0, 0] < -1
    assert box[1, 0] > 11


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 - x**2 - y**2 - z**2", "no bounded inside"),
        ("x**2 + y**2 - 1", "no bounded inside"),
        ("x**2 + y**2 + z**2 + 1", "no bounded inside"),
        ("x**2 + y**2 + z**2 - 1 + 0*sqrt(x)", "not a finite number"),
    ],
)
def test_fields_without_a_bounded_inside_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        FieldSource(text).bounding_box()


def test_a_run_of_a_formula(tmp_path: Path, cli: Cli) -> None:
    text = "-1 + x**2 + 2*y**2 + z**2"
    done = cli("run", "--field", text, "-n", 8, "--until", "evaluate", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "formula.vorolight"
    found = json.loads((run / "evaluate-sphere-train.json").read_text())["metrics"]
    assert found["topology"]["euler_number"] == 2
    # An ellipsoid's volume, 4/3 pi a b c; triangles of a coarse surface lie inside it.
    assert found["volume"] == pytest.approx(4 / 3 * np.pi / np.sqrt(2), rel=0.06)
    recorded = json.loads((run / "classify.json").read_text())
    assert f"--field '{text}'" in recorded["command"]
    again = cli("status", "--field", text, "--json", cwd=tmp_path)
    states = {row["stage"]: row for row in map(json.loads, again.stdout.splitlines())}
    assert states["sphere-train"]["state"] == "done"
    assert states["fabricate"]["state"] == "to do"
    done = cli("classify", "heart", "--field", text, cwd=tmp_path)
    assert done.returncode == 2
    assert "give one of them" in done.stderr


def test_torchs_functions_are_settled_before_threads_share_them() -> None:
    assert set(ONE) - {"abs"} <= set(torch_start.FUNCTIONS)
    torch_start.settle()
    points = torch.linspace(0.1, 0.9, 200_000, dtype=torch.float64)
    for name in torch_start.FUNCTIONS:
        function = getattr(torch, name)
        alone = function(points[:100])
        assert torch.allclose(function(points)[:100], alone, rtol=1e-14, atol=0)  # some last bits
