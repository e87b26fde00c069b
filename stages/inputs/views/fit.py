"""A closed triangle surface fitted to silhouettes and normals by Gauss-Newton steps.

The squares of two kinds of residuals are summed: edges of seen triangles times the normals that
the views show there (an integral of squared slopes), and distances of the outlines, as drawn, to
those of the masks. Gradient steps on the losses of ``losses.images`` are slow where the surface is
far from the first.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ...mesh.edge_table import EdgeTable, Sized
from ...mesh.geometry import limited, triangle_areas
from ...mesh.polygons import Floats, Ints
from ...remesh.operations import contract_short, flip, fold_cosines, split_long, valence_gain
from ...remesh.remeshing import relax
from ...render import visibility
from ...render.cameras import facing, ray_matrix, visible
from ...render.views import MOST_VIEWS, Views
from ...solvers.laplacian import Laplacian
from ...solvers.least_squares import Block, GaussNewton
from .node_grid import NodeGrid


@dataclass(frozen=True)
class Level:
    """Edges about ``edge`` long, in units of the longest side; ``rounds`` of a remeshing each."""

    edge: float
    rounds: int
    cells: int = 120
    """Of a unit, on which crossing parts are united before."""


LEVELS = (Level(1 / 50, 8), Level(1 / 50, 4), Level(1 / 90, 3))
BLIND_LEVELS = (Level(1 / 90, 2, 180), Level(1 / 90, 3, 180))
"""Of views without normals. The hull is near what they tell: longer edges and larger cells would
take from its thin parts what no normal brings back."""
STEPS = 2
"""Gauss-Newton steps in a round."""
SPECK = 1e-4
"""Share of the volume of the largest piece below which a piece is left out then."""
OUTLINE = 3.0
"""Weight of the outlines: of squared distances in edges, integrated along them."""
BEND, UNTOLD, BLIND = 0.05, 0.3, 1.0
"""Weights of vertices amid their neighbours: where normals are seen, where none are, and where
there are no normal maps."""
DAMPING = 1e-2
FAR = 10.0
"""Pixels between outlines from which they count less, if masks may be wrong."""
SURE = 1.5
"""Power of the share of a triangle's area that the views show, in its weight."""
FOLDED, UNFOLDINGS = -0.2, 30
"""Cosine of the normals of two triangles from which on their edge is folded, and how often such
edges are smoothed."""
RELAXED = 0.5
"""Of the way to the middle of its triangles, for a vertex in a round of remeshing."""


@dataclass(frozen=True)
class Seen:
    """What one view shows of the surface."""

    votes: Floats
    """Sums of target normals, by triangle ``(T, 3)``."""
    area: float
    """That a pixel covers."""
    edges: Ints
    """Those of the outline ``(E,)``; what follows is of each of them."""
    length: Floats
    part: Floats
    """Where the outline was looked at, as a share of the way along the edge."""
    away: Floats
    """Distance to the outline of the mask, positive inside of it."""
    slope: Floats
    """Its derivatives by the place ``(E, 3)``."""
    pixels: Floats
    """The same distance in pixels."""


def fit(
    vertices: Floats,
    triangles: Ints,
    views: Views,
    distances: Floats,
    doubtful: bool,
    random: np.random.Generator,
    threads: int,
    tick: Callable[[], None] = lambda: None,
) -> tuple[Floats, Ints]:
    """The closed surface moved to what the ``views`` show; its longest side is about 1.

    ``distances (N, H, W)`` are those to the outlines of the masks in pixels, positive inside;
    ``doubtful`` masks may be wrong. ``tick`` is called after each round.
    """
    mesh = Sized(vertices, triangles, np.zeros(len(vertices)))
    for number, level in enumerate(levels(views)):
        if number:
            mesh = _solid(mesh, level.cells)
        for _ in range(level.rounds):
            mesh = _remeshed(mesh, level.edge)
            table = EdgeTable.of(mesh.triangles)
            for _ in range(STEPS):
                chosen = np.sort(random.permutation(len(views))[:MOST_VIEWS])
                seen = _observed(mesh, table, views, distances, chosen, threads)
                mesh.vertices = mesh.vertices + _step(mesh, table, seen, level.edge, doubtful)
            tick()
    _unfold(mesh)
    return mesh.vertices, mesh.triangles


def levels(views: Views) -> tuple[Level, ...]:
    """Those that ``fit`` goes through; it ticks once a round."""
    return LEVELS if views.normals is not None else BLIND_LEVELS


def _observed(
    mesh: Sized, table: EdgeTable, views: Views, distances: Floats, chosen: Ints, threads: int
) -> list[Seen]:
    vertices, triangles = mesh.vertices, mesh.triangles

    def one(number: int) -> Seen:
        camera = views.cameras[number]
        screen = camera.project(vertices)
        seen = visible(camera, screen, triangles)
        votes = np.zeros((len(triangles), 3))
        if views.normals is not None:
            visibility.normals_seen(seen, views.normals[number], ray_matrix(camera), votes)
        sums = np.zeros((len(table.ends), 5))
        visibility.outline(
            screen, table.ends, table.triangles, facing(screen, triangles), seen,
            distances[number], sums,
        )  # fmt: skip
        hit = np.flatnonzero(sums[:, 0])
        count = sums[hit, 0]
        part, pixels, *slope = (sums[hit, 1:] / count[:, None]).T
        a, b = table.ends[hit].T
        at = (1 - part[:, None]) * vertices[a] + part[:, None] * vertices[b]
        pixel = camera.size_of_pixel(at)
        slopes = np.einsum("in,nij->nj", np.array(slope), camera.jacobian(at))
        area = float(np.median(camera.size_of_pixel(vertices))) ** 2
        return Seen(
            votes, area, hit, count * pixel, part, pixels * pixel, slopes * pixel[:, None], pixels
        )

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, chosen.tolist()))


def _step(mesh: Sized, table: EdgeTable, seen: list[Seen], edge: float, doubtful: bool) -> Floats:
    """Movements ``(V, 3)``, none longer than an edge."""
    vertices, triangles = mesh.vertices, mesh.triangles
    areas = triangle_areas(vertices, triangles)
    votes = np.sum([each.votes for each in seen], axis=0)
    shown = sum(each.area * np.linalg.norm(each.votes, axis=1) for each in seen)
    # A vote from straight ahead weighs e; halfway to the side, less.
    share = np.minimum(1.0, shown / np.sqrt(np.e) / np.maximum(areas, np.finfo(float).tiny))
    size = np.linalg.norm(votes, axis=1)
    sure = np.where(size > 0, share**SURE, 0.0)
    blocks = []
    some = np.flatnonzero(sure)
    target = votes[some] / size[some, None]
    scale = np.sqrt(areas[some] / 3 * sure[some]) / edge
    for k in range(3):
        a, b = triangles[some, k], triangles[some, (k + 1) % 3]
        across = np.einsum("ij,ij->i", target, vertices[b] - vertices[a])
        values = scale[:, None] * np.concatenate([-target, target], axis=1)
        blocks.append(Block.dense(_columns(a, b), values, scale * across))
    for each in seen:
        weight = np.sqrt(OUTLINE * each.length / edge)
        if doubtful:
            weight = weight / (1 + (each.pixels / FAR) ** 2)
        a, b = table.ends[each.edges].T
        part = each.part[:, None]
        values = np.concatenate([(1 - part) * each.slope, part * each.slope], axis=1)
        blocks.append(Block.dense(_columns(a, b), weight[:, None] * values, weight * each.away))
    laplacian = Laplacian.of(table.ends, len(vertices))
    told = np.zeros(len(vertices), dtype=bool)
    told[triangles[some]] = True
    weight = np.where(told, BEND, UNTOLD if told.any() else BLIND)
    bent = weight[:, None] * laplacian(vertices)
    entries = laplacian.entries * weight[laplacian.rows]
    for k in range(3):
        blocks.append(Block(laplacian.rows, 3 * laplacian.columns + k, entries, bent[:, k]))
    free = np.ones(3 * len(vertices), dtype=bool)
    return limited(GaussNewton(blocks, free, width=3).step(DAMPING).reshape(-1, 3), edge)


def _solid(mesh: Sized, cells: int) -> Sized:
    """The surface of what the mesh goes round once: without what is inside out, or crosses."""
    import igl

    from ...mesh.queries.triangle_tree import TriangleTree

    cell = 1 / cells
    vertices, triangles = np.ascontiguousarray(mesh.vertices), mesh.triangles
    grid = NodeGrid.around(vertices, cell)
    inside = np.asarray(igl.fast_winding_number(vertices, triangles, grid.nodes)) > 0.5
    values = np.where(inside, cell, -cell)
    near = grid.beside(inside)
    square, _, _ = TriangleTree(vertices, triangles).closest(grid.nodes[near])
    distance = np.maximum(np.sqrt(square), 1e-6 * cell)
    values[near] = np.where(inside[near], distance, -distance)
    made, faces = grid.surface(values, SPECK)
    return Sized(made, faces, np.zeros(len(made)))


def _unfold(mesh: Sized) -> None:
    """Move the corners of folded edges, which contradictory masks make, amid their neighbours."""
    table = EdgeTable.of(mesh.triangles)
    laplacian = Laplacian.of(table.ends, len(mesh.vertices))
    for _ in range(UNFOLDINGS):
        folded = fold_cosines(mesh, table)[0] < FOLDED
        if not folded.any():
            break
        moved = np.unique(np.concatenate([table.ends[folded], table.opposite[folded]]))
        mesh.vertices[moved] -= laplacian(mesh.vertices)[moved]


def _columns(a: Ints, b: Ints) -> Ints:
    """Of the coordinates of two vertices each, ``(N, 6)``."""
    axis = np.arange(3)
    return np.concatenate([3 * a[:, None] + axis, 3 * b[:, None] + axis], axis=1)


def _remeshed(mesh: Sized, edge: float) -> Sized:
    """The same with edges about ``edge`` long."""
    length = np.full(len(mesh.vertices), edge)
    mesh = Sized(mesh.vertices.copy(), mesh.triangles.copy(), length)
    for _ in range(3):
        split_long(mesh)
        contract_short(mesh)
        flip(mesh, valence_gain)
        relax(mesh, RELAXED)
    return mesh
