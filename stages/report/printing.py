"""The report on printability: a verdict for each check, and pictures of the worst places."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..artifacts.run_folder import RunFolder
from ..mesh.polygons import Floats, Ints
from ..render import image_file, raster
from .pictures import PRINT, printed
from .tables import table

SPOT = np.array([0.85, 0.2, 0.15])
WINDOW, RADIUS = 12.0, 1.5
"""Half the edge of what a picture shows, and how far around the spot it is red; mm."""
SIZE = 220
FROM_BELOW = ("floating starts", "islands", "bridges", "overhangs")


def section(folder: RunFolder, metrics: Mapping[str, Any]) -> str:
    """HTML of the checks that stage fabricate made."""
    rows, figures = [], []
    vertices, triangles = printed(folder)
    for check in metrics["printability"]:
        rows.append(
            (html.escape(check["name"]), _said(check["verdict"]), html.escape(check["text"]))
        )
        if check["worst"] and check["name"] != "stability":
            below = check["name"] in FROM_BELOW
            image = close_up(vertices, triangles, np.array(check["worst"][0]), below)
            data = base64.b64encode(image_file.png(image)).decode()
            place = ", ".join(f"{x:.0f}" for x in check["worst"][0])
            figures.append(
                f'<figure><img alt="{html.escape(check["name"])}" width="{SIZE}" '
                f'src="data:image/png;base64,{data}"><figcaption>{html.escape(check["name"])}: '
                f"worst at ({place}) mm</figcaption></figure>"
            )
    sliced = metrics["as_written"].get("slicer")
    text = "not run (--slice)"
    if sliced:
        text = (
            f"{sliced['version']}: {sliced['layers']} layers, {sliced['filament_g']:.0f} g of "
            f"filament, {sliced['printing_time']}"
        )
        text += "".join(f"; {line}" for line in sliced["warnings"])
    verdict = "ok" if sliced else "not run"
    rows.append(("slicer", _said(verdict), html.escape(text)))
    return (
        f"<h2>Printability</h2>{table(('check', 'verdict', 'found'), rows, 'words')}"
        f'<div class="figures">{"".join(figures)}</div>'
    )


def _said(verdict: str) -> str:
    """A verdict in bold, and in its colour if it is a known one."""
    colour = {"ok": "good", "warn": "doubt", "fail": "bad"}.get(verdict, "")
    return f'<b class="{colour}">{html.escape(verdict)}</b>'


def close_up(vertices: Floats, triangles: Ints, spot: Floats, below: bool) -> Floats:
    """The part within WINDOW of ``spot``, seen from outside the object, with the spot in red."""
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    away = spot - middle
    azimuth = float(np.degrees(np.arctan2(away[1], away[0])))
    centres = vertices[triangles].mean(axis=1)
    away_by = np.abs(centres - spot).max(axis=1)
    # If triangles are large, none may have its centre that close.
    near = triangles[away_by < max(WINDOW, 1.5 * float(away_by.min()))]
    distance = np.linalg.norm(vertices[near].mean(axis=1) - spot, axis=1)
    colours = np.where((distance < max(RADIUS, float(distance.min()) + 0.5))[:, None], SPOT, PRINT)
    used, index = np.unique(near, return_inverse=True)
    view = raster.view("z", azimuth, -35.0 if below else 20.0)
    return raster.shaded(
        vertices[used], index.reshape(-1, 3), None, colours, view, 2 * SIZE, 2 * SIZE
    )
