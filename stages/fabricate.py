"""Stage fabricate: make a lamp, a lattice, a solid or cells to print. Writes STL and 3MF in
millimetres.

Example:
    >>> from vorolight.stages import fabricate
    >>> from vorolight.stages.engine.runner import execute
    >>> execute(session, "fabricate", fabricate.Params(lamp=True))  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .engine.stage import Context, Outcome, Stage
from .errors import UsageError
from .fabricate_params import Params, check_diameter
from .memory import peak

if TYPE_CHECKING:
    from .fabrication.lamp import Request
    from .mesh.polygons import PolygonMesh

BESIDE = 10.0
"""Distance in the 3MF file between the object and its lid, in mm."""


def run(context: Context) -> Outcome:
    """Make the object (paper's appendix E.2): tubes along even cells or along the trained faces.

    For trained triangles the tubes follow the dual, a polygon around each vertex.
    """
    from .fabrication import lattice, products, slicer
    from .fabrication.even_cells import even_cells
    from .inputs.resolve import recorded_up
    from .mesh.dual import dual
    from .mesh.polygons import PolygonMesh

    params = context.params
    if params.slice:
        slicer.program()  # a missing slicer is reported now, not at the end
    trained = context.arrays("sphere-train")
    polygons, surface = (
        PolygonMesh.from_arrays(trained, prefix) for prefix in ("trained/", "surface/")
    )
    recorded = context.folder.manifest("classify") or {}
    up = params.up if params.up != "auto" else recorded_up(recorded)
    volume = context.arrays("volume") if params.needs_volume else None
    context.progress.start("fabricate", 4)
    asked = _request(params, up)
    width, drawn = params.cell_width, "trained polygons"
    if width is not None:
        try:
            polygons = even_cells(surface, width / _scale(surface, asked), context.threads)
        except ValueError as error:
            raise UsageError(
                f"--cell-size {width:g}: cells need a closed surface ({error}); train the "
                "surface until it has a certificate"
            ) from error
        drawn = "cells"
    elif (polygons.valences == 3).all():
        polygons, drawn = dual(polygons), "dual"
    shape = lattice.Shape(polygons=polygons, surface=surface, drawn=drawn, volume=volume)
    if params.mode == "solid":
        made = products.solid(shape, asked, params.wall)
    elif params.explode > 1:
        made = products.exploded(shape, asked, params.explode)
    else:
        design = lattice.Design(
            params.which_edges, params.tube_diameter, params.taper, params.sides, params.fillet,
            params.merge, params.plate_share, params.plate_pattern, params.plate_thickness,
            params.cable, params.nozzle, params.layer, lambda d: check_diameter(d, params),
        )  # fmt: skip
        made = products.tubes_of(shape, asked, design, context.random("plates"), context.progress)
    return _written(context, made, Path(recorded["inputs"][0]["name"]).stem)


def _scale(surface: PolygonMesh, asked: Request) -> float:
    """Millimetres of the object divided by units of the input."""
    import numpy as np

    from .fabrication import lamp

    stance = lamp.stand(surface, surface, replace(asked, light=None))
    return float(np.cbrt(np.linalg.det(stance.mm_from_input[:3, :3])))


def _request(params: Params, up: str) -> Request:
    from .fabrication import lamp, lights

    preset = params.light or ("tea-light" if params.mode in ("lamp", "cells") else "none")
    light = lights.PRESETS.get(preset)
    if params.base == "none" or params.explode > 1:
        light = None
    if light is not None:
        if params.light_diameter is not None:
            light = replace(light, diameter=params.light_diameter)
        if params.light_height is not None:
            light = replace(light, height=params.light_height)
    flat = params.mode in ("lamp", "cells", "solid") and params.explode == 1
    base = params.base if flat else "none"
    return lamp.Request(
        up, params.height, 0.0, params.trim, base, light, preset, params.clearance,
        1.6 if params.wall is None else params.wall, params.bayonet, params.room,
    )  # fmt: skip


def _written(context: Context, made: Any, name: str) -> Outcome:
    """Files, checks and figures of a product."""
    import numpy as np

    from .fabrication import printcheck, slicer
    from .formats import glb, obj, ply, stl, threemf
    from .mesh.polygons import PolygonMesh

    params = context.params
    part, low = made.part, made.part.vertices.min(axis=0)
    size = tuple(float(x) for x in part.vertices.max(axis=0) - low)
    checks = made.checks(params.room, params.nozzle, params.layer)
    fit = next(check for check in checks if check.name == "bed")
    if fit.verdict == "fail":
        raise UsageError(
            f"--bed {params.bed}: the object does not fit ({fit.text}); lower --height"
        )
    warnings = list(made.warnings)
    bodies = [threemf.Body(made.name, part.vertices, part.triangles)]
    files = {
        "stl": stl.encode(part.vertices, part.triangles),
        "ply": ply.encode(
            PolygonMesh.of_triangles(part.vertices.astype(np.float64), part.triangles)
        ),
    }
    if made.lid is not None:
        # Beside the object, where it can be printed: locked inside the object, the two would fuse.
        right = part.vertices[:, 0].max() - made.lid.vertices[:, 0].min() + np.float32(BESIDE)
        beside = made.lid.vertices + np.array([right, 0, 0], np.float32)
        bodies.append(threemf.Body("lid", beside, made.lid.triangles))
        files["lid.stl"] = stl.encode(made.lid.vertices, made.lid.triangles)
    files["3mf"] = threemf.encode(bodies, f"{name} {made.name}", "vorolight")
    if "obj" in params.wanted_formats:
        files["obj"] = obj.encode(part.vertices, part.triangles)
    if "glb" in params.wanted_formats:
        x, y, z = 1e-3 * part.vertices.astype(np.float64).T
        colours = np.full((len(part.vertices), 3), 235, np.uint8)
        files["glb"] = glb.encode(np.stack([x, z, -y], axis=1), part.triangles, colours)
    if params.render:
        from .render import lit

        context.progress.advance(3, "picture")
        scene = part.vertices, part.triangles, made.light_at
        if lit.traced():
            files["png"] = lit.png(*scene, context.threads)
        else:
            files["png"] = lit.rasterised(*scene)
            warnings.append(
                "Mitsuba is not installed: the picture is rasterised, without shadows; for "
                "a path-traced picture, run: pip install 'vorolight[render]'"
            )

    def recheck(paths: dict[str, Path]) -> dict[str, Any]:
        found = printcheck.of_files(paths, made.expected_bodies)
        if params.slice:
            found["slicer"] = slicer.slice_file(
                paths["stl"], size[2], params.layer, params.nozzle, params.room,
                made.expected_bodies,
            ).as_json()  # fmt: skip
        return found

    context.progress.advance(4)
    failed = [f"{check.name}: {check.text}" for check in checks if check.verdict == "fail"]
    warned = [f"{check.name}: {check.text}" for check in checks if check.verdict == "warn"]
    metrics = made.metrics | {
        "mode": params.mode,
        "printability": [check.as_json() for check in checks],
        "printable": not failed,
    }
    return Outcome(
        arrays=made.arrays | {"mm_from_input": made.mm_from_input},
        files=files,
        metrics=metrics,
        warnings=[
            *warnings,
            *(f"the object is not printable as it is: {text}" for text in failed),
            *warned,
        ],
        frame={
            "unit": "mm",
            "input_from_model": np.linalg.inv(made.mm_from_input).tolist(),
            "bounding_box": [low.tolist(), part.vertices.max(axis=0).tolist()],
        },
        recheck=recheck,
    )


def _memory(context: Context) -> float:
    params = context.params
    each = 52.0 * (params.sides / 12) ** 2 * (2 if params.fillet else 1)
    if params.mode == "solid":
        return peak(300.0, 500.0, 0.0, 0)
    corners = (
        context.arrays("volume")["face_vertices"]
        if params.needs_volume
        else context.arrays("sphere-train")["trained/face_vertices"]
    )
    # An edge has two faces on a surface and about three in a volume; each face is counted once.
    return peak(400.0, 300.0, each, len(corners) / (3 if params.needs_volume else 2))


def _parents(params: Params) -> tuple[str, ...]:
    return ("classify", "sphere-train", *(["volume"] if params.needs_volume else []))


STAGE = Stage(
    name="fabricate",
    version=8,
    params=Params,
    run=run,
    parents=_parents,
    memory=_memory,
)
