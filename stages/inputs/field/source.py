"""Implicit fields, built in, a formula or samples: negative inside, zero on the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...mesh.creases import Chain
from ...mesh.model_frame import ModelFrame
from ...mesh.polygons import Floats
from ...mesh.queries.true_surface import TrueSurface
from ...torch_start import settle
from ..source import Source
from . import code
from .expression import Formula, parse, search_box
from .grid import SampledField, load


def _heart(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """Taubin's heart (1993), as in the paper's section 4.1."""
    body = x * x + 2.25 * y * y + z * z - 1
    return body * body * body - (x * x + 9 / 80 * y * y) * z * z * z


def _sphere(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """The unit sphere's signed distance."""
    return xp.sqrt(x * x + y * y + z * z) - 1


def _cube_cavity(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """``max(F_cube, -F_sphere)``: half-edge 0.5, a closed spherical cavity of radius 0.4."""
    cube = xp.maximum(xp.maximum(xp.abs(x), xp.abs(y)), xp.abs(z)) - 0.5
    return xp.maximum(cube, 0.4 - xp.sqrt(x * x + y * y + z * z))


def _torus(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """A torus about the z axis, radii 1 and 0.4: its signed distance."""
    ring = xp.sqrt(x * x + y * y) - 1
    return xp.sqrt(ring * ring + z * z) - 0.4


def _gyroid(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """One of the gyroid's two labyrinths, a period and a half of it in a ball, rims rounded."""
    wave = xp.sin(x) * xp.cos(y) + xp.sin(y) * xp.cos(z) + xp.sin(z) * xp.cos(x)
    ball = xp.sqrt(x * x + y * y + z * z) - 1.5 * np.pi
    return 0.5 * (wave + ball + xp.sqrt((wave - ball) * (wave - ball) + 1.0))


def _genus_two(x: Any, y: Any, z: Any, xp: ModuleType) -> Any:
    """A solid figure of eight: a tube around Gerono's lemniscate ``x^2 (1 - x^2) = y^2``."""
    curve = x * x * (1 - x * x) - y * y
    return curve * curve + 0.5 * z * z - 0.025


ON = 0.01
"""Distance of a crease from the zero set in units of h0 up to which it is sharp: where the field is
round, dual contouring makes pieces that lie off it."""


@dataclass(frozen=True)
class Field:
    """A formula, a box ``(2, 3)`` that holds what is inside, and the radius of a ball about the
    box's middle that does."""

    formula: Formula
    box: Floats
    radius: float


def _cube(formula: Formula, half_edge: float, radius: float) -> Field:
    return Field(formula, np.array([[-half_edge] * 3, [half_edge] * 3]), radius)


FIELDS = {
    "heart": _cube(_heart, 1.5, 1.45),
    "cube-cavity": _cube(_cube_cavity, 0.75, 0.87),
    "sphere": _cube(_sphere, 1.5, 1.01),
    "torus": _cube(_torus, 1.75, 1.41),
    "gyroid": _cube(_gyroid, 5.0, 4.72),
    "genus-two": _cube(_genus_two, 1.3, 1.4),
}


@dataclass
class FieldSource(Source):
    """A built-in field, the formula or function that is its name, or the samples in a file."""

    name: str
    kind: str = "field"
    path: Path | None = None
    allow_code: bool = False
    above: float | None = None
    """Of samples: what is above this value is inside; None: what is negative."""

    @cached_property
    def field(self) -> Field:
        """Raises InputError for a formula that is not allowed or has no bounded inside, and for a
        file that holds no field, UsageError for code that is not allowed."""
        if self.path is not None:
            sampled = load(self.path, self.above)
            radius = 0.5 * float(np.linalg.norm(sampled.box[1] - sampled.box[0]))
            return Field(sampled, sampled.box, radius)
        if self.name in FIELDS:
            return FIELDS[self.name]
        formula = (
            code.load(self.name, self.allow_code) if code.is_code(self.name) else parse(self.name)
        )
        box = search_box(
            lambda at: np.asarray(formula(at[:, 0], at[:, 1], at[:, 2], np)), self.name
        )
        return Field(formula, box, 0.5 * float(np.linalg.norm(box[1] - box[0])))

    needs_torch = True

    @property
    def options(self) -> frozenset[str]:
        return frozenset() if self.path is None else frozenset({"level"})

    def configure(self, values: Mapping[str, Any]) -> None:
        self.above = values["level"]

    @property
    def box_is_tight(self) -> bool:
        """No: the box is the region that is searched."""
        return False

    def bounding_box(self) -> Floats:
        return self.field.box.copy()

    def value(self, points: Floats) -> Floats:
        """The level-set value F at ``points (N, 3)``, ``(N,)``."""
        return np.asarray(self.field.formula(points[:, 0], points[:, 1], points[:, 2], np))

    def level(self, points: Any) -> Any:
        """F as a differentiable function of a torch tensor ``(N, 3)``."""
        import torch

        settle()
        x, y, z = points.unbind(1)
        return self.field.formula(x, y, z, torch)

    def gradient(self, points: Floats) -> tuple[Floats, Floats]:
        """F ``(N,)`` and its gradient ``(N, 3)`` at ``points (N, 3)``."""
        import torch

        if isinstance(self.field.formula, SampledField):
            return self.field.formula.value_and_gradient(points)
        at = torch.tensor(points, requires_grad=True)
        value = self.level(at)
        (slope,) = torch.autograd.grad(value.sum(), at)
        # Where a root's argument is zero there is none.
        return value.detach().numpy(), np.nan_to_num(slope.numpy(), posinf=0.0, neginf=0.0)

    def mean_curvature(self, points: Floats) -> Floats:
        """``H = div(grad F / |grad F|) / 2`` at ``points (N, 3)``, by automatic differentiation."""
        import torch

        at = torch.tensor(points, requires_grad=True)
        (gradient,) = torch.autograd.grad(self.level(at).sum(), at, create_graph=True)
        normal = gradient / torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        divergence = torch.zeros(len(points), dtype=torch.float64)
        for axis in range(3):
            if normal[:, axis].requires_grad:
                (row,) = torch.autograd.grad(normal[:, axis].sum(), at, retain_graph=True)
                divergence += row[:, axis]
        return np.asarray(0.5 * divergence)

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        return self.value(points) < 0

    def may_cross(self, origin: Floats, edge: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """All: of a field nothing is known between its samples."""
        return np.ones(shape, dtype=bool)

    def surface_samples(self, count: int, random: np.random.Generator) -> Floats:
        """Crossings of random lines with the surface.

        Lines that are uniform in direction and offset meet every piece of surface in proportion to
        its area (Cauchy-Crofton), so no mesh is needed and none biases the sample.
        """
        radius, centre = self.field.radius, self.field.box.mean(axis=0)
        steps = np.linspace(-radius, radius, 200)
        found: list[Floats] = []
        total = 0
        while total < count:
            direction = random.normal(size=(4096, 3))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            offset = random.normal(size=(4096, 3))
            offset -= np.einsum("ij,ij->i", offset, direction)[:, None] * direction
            offset /= np.linalg.norm(offset, axis=1, keepdims=True)
            offset *= radius * np.sqrt(random.random((4096, 1)))
            offset += centre
            points = offset[:, None] + steps[:, None] * direction[:, None]
            below = (self.value(points.reshape(-1, 3)) < 0).reshape(4096, -1)
            line, step = np.nonzero(below[:, 1:] != below[:, :-1])
            low, high = steps[step], steps[step + 1]
            starts_inside = below[line, step]
            for _ in range(50):
                middle = 0.5 * (low + high)
                at = offset[line] + middle[:, None] * direction[line]
                same = (self.value(at) < 0) == starts_inside
                low, high = np.where(same, middle, low), np.where(same, high, middle)
            found.append(offset[line] + (0.5 * (low + high))[:, None] * direction[line])
            total += len(line)
        return np.concatenate(found)[:count]

    def true_surface(self, frame: ModelFrame, threads: int) -> TrueSurface:
        """The zero set in model units."""
        from .true_surface import FieldSurface

        return FieldSurface(self, frame)

    def exact_creases(self, frame: ModelFrame, angle: float) -> list[Chain]:
        """Where the gradient jumps."""
        from ..creases.contouring import contoured
        from ..creases.sharp_edges import of_triangles

        made = of_triangles(*contoured(self, frame), angle)
        return [chain for chain in made if self._distance(frame, chain.points) < ON]

    def _distance(self, frame: ModelFrame, points: Floats) -> float:
        """Median distance, to first order, of ``points (N, 3)`` from the zero set in units of
        h0."""
        value, slope = self.gradient(frame.input_from_model(points))
        steepness = np.maximum(np.linalg.norm(slope, axis=1), np.finfo(float).tiny)
        return float(np.median(np.abs(value) / steepness) / frame.spacing)

    def creases(self, surface: TrueSurface, frame: ModelFrame, angle: float) -> list[Chain]:
        """Exact ones and rounded ones."""
        from ..creases.combined import combined

        box = frame.model_from_input(np.asarray(self.bounding_box(), dtype=float))
        return combined(self.exact_creases(frame, angle), surface, box, angle, exact=True)

    def describe(self) -> dict[str, Any]:
        return {"kind": self.kind, "name": self.name}

    def state(self) -> dict[str, Any]:
        return {} if self.above is None else {"source/level": np.array(self.above)}

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Take what ``state`` was, of the same field."""
        if "source/level" in stored:
            self.above = float(stored["source/level"])

    def warnings(self) -> list[str]:
        formula = self.field.formula
        return list(formula.notes) if isinstance(formula, SampledField) else []
