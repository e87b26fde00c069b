"""The diagrams of docs/method.md, computed in the plane and written as SVG.

Run with ``make -C examples diagrams``. In the plane a face of the surface is an edge of a curve.
The circles at its two ends meet in two points, and these are its pair of generators.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial import Voronoi

INSIDE, OUTSIDE, CELL, CURVE, SPHERE, FOREIGN = (
    "#c8641e", "#2b6cb0", "#c9ced6", "#111111", "#8a63b8", "#c0182b"
)  # fmt: skip
SIZE, MARGIN = 420, 1.35


def shape(angle: np.ndarray, waist: bool = False) -> np.ndarray:
    """Points of a smooth closed curve, ``(N, 2)``, with a narrow waist or without."""
    radius = 0.62 + 0.52 * np.cos(2 * angle) if waist else 0.85 + 0.13 * np.cos(3 * angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def on_page(points: np.ndarray) -> np.ndarray:
    """Pixels of ``points (N, 2)``; y points up in the plane and down on the page."""
    return SIZE * (0.5 + 0.5 * np.asarray(points) * [1, -1] / MARGIN)


def line(a: np.ndarray, b: np.ndarray, colour: str, width: float) -> str:
    (x, y), (u, v) = on_page(np.stack([a, b]))
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" '
        f'stroke="{colour}" stroke-width="{width}" stroke-linecap="round"/>'
    )


def dots(points: np.ndarray, colour: str) -> list[str]:
    return [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.4" fill="{colour}"/>' for x, y in on_page(points)
    ]


def circles(centres: np.ndarray, radii: np.ndarray, colours: Iterable[str]) -> list[str]:
    return [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r * SIZE / 2 / MARGIN:.1f}" fill="none" '
        f'stroke="{colour}" stroke-width="1"/>'
        for (x, y), r, colour in zip(on_page(centres), radii, colours, strict=True)
    ]


def interface(points: np.ndarray, inside: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Segments ``(2, 2)`` of the Voronoi diagram: between the labels, and all others."""
    # Four far generators bound the cells that are drawn.
    far = 20.0 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    diagram = Voronoi(np.concatenate([points, far]))
    label = np.concatenate([inside, np.zeros(4, dtype=bool)])
    between, others = [], []
    for pair, ends in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        if min(ends) >= 0:
            side = between if label[pair[0]] != label[pair[1]] else others
            side.append(diagram.vertices[ends])
    return between, others


def pairs(centres: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inner and outer generator of every edge: where the circles at its ends meet."""
    after, other = np.roll(centres, -1, axis=0), np.roll(radii, -1)
    way = after - centres
    length = np.linalg.norm(way, axis=1)
    along = (length**2 + radii**2 - other**2) / (2 * length)
    offset = np.sqrt(radii**2 - along**2)
    unit = way / length[:, None]
    foot, normal = centres + along[:, None] * unit, np.stack([unit[:, 1], -unit[:, 0]], axis=1)
    return foot - offset[:, None] * normal, foot + offset[:, None] * normal


def picture(points: np.ndarray, inside: np.ndarray, below: list[str], above: list[str]) -> str:
    between, others = interface(points, inside)
    body = [line(a, b, CELL, 1) for a, b in others] + below
    body += [line(a, b, CURVE, 2.6) for a, b in between]
    body += dots(points[inside], INSIDE) + dots(points[~inside], OUTSIDE) + above
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE} {SIZE}" '
        f'width="{SIZE}" height="{SIZE}">\n<rect width="{SIZE}" height="{SIZE}" fill="#ffffff"/>\n'
        + "\n".join(body)
        + "\n</svg>\n"
    )


def labelled() -> str:
    """Scattered generators with labels: the interface is closed, and bumpy."""
    points = np.random.default_rng(4).uniform(-1.25, 1.25, (190, 2))
    angle = np.arctan2(points[:, 1], points[:, 0])
    inside = np.linalg.norm(points, axis=1) < np.linalg.norm(shape(angle), axis=1)
    return picture(points, inside, [], [])


def spheres(waist: bool) -> tuple[np.ndarray, np.ndarray]:
    """Centres ``(N, 2)`` along the curve and radii ``(N,)`` with which neighbours meet."""
    angle = np.linspace(0, 2 * np.pi, 23)[:-1]
    if waist:  # as many vertices at the waist as elsewhere
        fine = np.linspace(0, 2 * np.pi, 4001)
        steps = np.linalg.norm(np.diff(shape(fine, waist), axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        angle = np.interp((angle / (2 * np.pi) + 0.5 / 22) * along[-1], along, fine)
    centres = shape(angle, waist)
    length = np.linalg.norm(centres - np.roll(centres, -1, axis=0), axis=1)
    return centres, 0.72 * np.maximum(length, np.roll(length, 1))


def trained(waist: bool) -> str:
    """Circles at the vertices of a curve, and the diagram of the pairs where they meet.

    At a narrow waist some circles contain generators that are not theirs: intruders.
    """
    centres, radii = spheres(waist)
    inner, outer = pairs(centres, radii)
    points = np.concatenate([inner, outer])
    owner = np.tile(np.arange(len(centres)), 2)
    # A generator belongs to the circles at the two ends of its edge.
    reach = np.linalg.norm(points[:, None] - centres[None], axis=2) - radii[None]
    own = (owner[:, None] - np.arange(len(centres))[None]) % len(centres)
    foreign = (reach < -1e-9) & (own != 0) & (own != len(centres) - 1)
    assert foreign.any() == waist
    colours = [FOREIGN if bad else SPHERE for bad in foreign.any(axis=0)]
    marks = dots(points[foreign.any(axis=1)], FOREIGN)
    inside = np.arange(len(points)) < len(centres)
    return picture(points, inside, circles(centres, radii, colours), marks)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("labelled", labelled()), ("certified", trained(False)), ("intruder", trained(True))
    ):  # fmt: skip
        (folder / f"{name}.svg").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
