"""The interactive view: a run's surfaces packed into the page, and the controls around them."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.polygons import Floats
from .surfaces import MODES, Shape

STOPS = (
    (68, 1, 84), (72, 40, 120), (62, 73, 137), (49, 104, 142), (38, 130, 142), (31, 158, 137),
    (53, 183, 121), (110, 206, 88), (181, 222, 43), (253, 231, 37),
)  # fmt: skip
"""The colour map viridis at ten even steps; people with colour blindness can read it."""
ROBUST = (2.0, 98.0)
"""Percentiles between which the colours run, so that a few bad places do not hide the rest."""
PREFERRED = ("sphere-train", "trained", "init", "source", "input", "voxels")
"""The first of these surfaces that exists is shown first."""
TURN = {"y": 60.0, "z": -60.0}
RISE = 18.0


@dataclass(frozen=True)
class Panel:
    """One of the views side by side: its name, its surfaces, and the missing ones."""

    name: str
    shapes: Sequence[Shape]
    absent: dict[str, str]


def asset(name: str) -> str:
    """A text that is installed beside this module."""
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def script_hash() -> str:
    """The hash of the only script that the page's security policy allows."""
    digest = hashlib.sha256(_script().encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def _script() -> str:
    return "\n" + asset("viewer.js")


def first_of(panels: Sequence[Panel]) -> str:
    """The surface to begin with."""
    there = [shape.key for panel in panels for shape in panel.shapes]
    return next((key for key in PREFERRED if key in there), there[0])


def section(panels: Sequence[Panel], ups: Sequence[str], same_frame: bool, heading: str) -> str:
    """HTML of the view; ``ups`` are y or z. In one frame all panels show the same place."""
    if not any(panel.shapes for panel in panels):
        return ""
    frames = [_frame(panel.shapes) for panel in panels]
    if same_frame:
        shared = _frame([shape for panel in panels for shape in panel.shapes])
        frames = [shared for _ in panels]
    blobs, described = [], []
    for number, (panel, (centre, radius)) in enumerate(zip(panels, frames, strict=True)):
        surfaces = []
        for k, shape in enumerate(panel.shapes):
            facts, data = packed(shape)
            surfaces.append(facts)
            blobs.append(f'<script type="text/plain" id="blob-{number}-{k}">{data}</script>\n')
        described.append(
            {
                "up": "xyz".index(ups[number]),
                "turn": float(np.radians(TURN[ups[number]])),
                "name": panel.name,
                "centre": [float(x) for x in centre],
                "radius": radius,
                "surfaces": surfaces,
                "absent": panel.absent,
            }
        )
    first = first_of(panels)
    scene = {
        "elevation": float(np.radians(RISE)),
        "stops": STOPS,
        "first": first,
        "modes": [
            {"key": key, "title": title, "unit": unit} for key, (title, unit) in MODES.items()
        ],
        "panels": described,
    }
    return (
        f'<section class="viewer" aria-label="Interactive view"><h2>{html.escape(heading)}</h2>'
        "<noscript><p>The interactive view needs JavaScript; the pictures below show the same "
        f"surfaces.</p></noscript>{_controls(panels, first)}"
        f'<p class="failure" hidden></p><div class="panels">{_panels(panels)}</div>{_legend()}'
        f'<script type="application/json" id="scene">{_json(scene)}</script>\n{"".join(blobs)}'
        f"<script>{_script()}</script></section>"
    )


def _frame(shapes: Sequence[Shape]) -> tuple[Floats, float]:
    """Centre and radius of a ball around the shapes; outlying points count only if there is nothing
    else."""
    solid = [shape.mesh.vertices for shape in shapes if shape.mesh is not None]
    every = solid or [shape.points for shape in shapes if shape.points is not None]
    if not every:
        return np.zeros(3), 1.0
    places = np.concatenate([p for p in every if p is not None])
    centre = 0.5 * (places.min(axis=0) + places.max(axis=0))
    return centre, float(np.linalg.norm(places - centre, axis=1).max()) or 1.0


def packed(shape: Shape) -> tuple[dict[str, Any], str]:
    """What the page's script has to know of a shape, and its arrays as deflated base64.

    Positions are 16-bit steps of a 65535th of the longest side.
    """
    mesh = shape.mesh
    places = shape.points if mesh is None else mesh.vertices
    assert places is not None
    low = places.min(axis=0)
    step = float(np.ptp(places, axis=0).max()) / 65535 or 1.0
    arrays: dict[str, NDArray[Any]] = {
        "positions": np.rint((places - low) / step).astype("<u2").reshape(-1)
    }
    if mesh is not None:
        narrow = mesh.vertex_count <= 1 << 16
        arrays["corners"] = mesh.face_vertices.astype("<u2" if narrow else "<u4")
        if (mesh.valences != 3).any():
            # A face of more than 255 corners cannot be a cell's face, so 16 bits are enough.
            arrays["valences"] = mesh.valences.astype("<u2")
    if shape.tint is not None:
        arrays["tint"] = shape.tint.astype("u1")
    fields = {}
    for mode, found in shape.fields.items():
        known = found.values[np.isfinite(found.values)]
        if not len(known):
            continue
        low_value, high_value = (float(x) for x in np.percentile(known, ROBUST))
        fields[mode] = {"per": found.per, "low": low_value, "high": high_value}
        arrays[mode] = found.values.astype("<f4")
    content = b"".join(
        data + bytes(-len(data) % 4) for data in (array.tobytes() for array in arrays.values())
    )
    facts = {
        "key": shape.key,
        "low": [float(x) for x in low],
        "step": step,
        "arrays": [
            (name, f"{array.dtype.kind}{array.dtype.itemsize}", len(array))
            for name, array in arrays.items()
        ],
        "fields": fields,
        "missing": {key: text for key, text in shape.missing.items() if key not in fields},
        "colour": _bytes(shape.colour),
        "second": _bytes(shape.second),
        "edges": shape.edges,
        "note": shape.note,
    }
    return facts, base64.b64encode(zlib.compress(content, 9)).decode()


def _bytes(colour: Floats) -> list[int]:
    return [round(255 * float(channel)) for channel in colour]


def _json(value: Any) -> str:
    """JSON that cannot end its script element: ``<`` is escaped."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _controls(panels: Sequence[Panel], first: str) -> str:
    titles = {shape.key: shape.title for panel in panels for shape in panel.shapes}
    # In the order of the stages, also if a view lacks some of them.
    longest = max(panels, key=lambda panel: len(panel.shapes))
    order = [shape.key for shape in longest.shapes]
    order += [key for key in titles if key not in order]
    choices = "".join(
        f'<label><input type="radio" class="surface" name="surface" value="{key}"'
        f"{' checked' if key == first else ''}><span>{html.escape(titles[key])}</span></label>"
        for key in order
    )
    colours = '<option value="plain" selected>Plain</option>' + "".join(
        f'<option value="{key}">{html.escape(title)}</option>' for key, (title, _) in MODES.items()
    )
    return (
        '<form class="controls" hidden autocomplete="off"><fieldset class="choices">'
        "<legend>Surface</legend>"
        f'<div>{choices}</div></fieldset><div class="row">'
        f'<label>Colour <select class="mode">{colours}</select></label>'
        '<label><input type="checkbox" class="edges" checked> Edges</label>'
        '<label><input type="checkbox" class="shared"> One scale for all surfaces</label>'
        '<span class="buttons"><button type="button" class="closer" aria-label="Zoom in">+</button>'
        '<button type="button" class="farther" aria-label="Zoom out">−</button>'
        '<button type="button" class="reset">Reset</button></span></div></form>'
    )


def _panels(panels: Sequence[Panel]) -> str:
    several = len(panels) > 1
    return "".join(
        '<figure class="panel">'
        + (f"<figcaption>{html.escape(panel.name)}</figcaption>" if several else "")
        + '<div class="box"><canvas class="live" tabindex="0" role="img" aria-label="Surface of '
        f'{html.escape(panel.name)} in three dimensions; arrow keys rotate it"></canvas>'
        '<canvas class="printed"></canvas><p class="message" hidden></p></div></figure>'
        for panel in panels
    )


def _legend() -> str:
    return (
        '<div class="legend" hidden><span class="title"></span>'
        '<canvas width="256" height="1"></canvas><span class="scale"></span></div>'
        '<p class="note" role="status"></p><p class="help">Drag to rotate, two fingers or Shift to '
        "move, wheel or pinch to zoom. Keys: arrows, Shift and arrows, + and −, 0 to reset, w for "
        "edges. Colours run from the 2nd to the 98th percentile.</p>"
    )
