"""The unstructured grid of MODFLOW 6 (DISU), written by flopy."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from ..errors import BackendMissing
from ..mesh.dual_graph import DualGraph

DIGITS = 15
"""Number of digits after the decimal point."""


def encode(graph: DualGraph) -> dict[str, bytes]:
    """The file ``mesh.disu``.

    MODFLOW takes areas from layers: each cell becomes a layer of the same thickness h, which is the
    mean size of the cells, with the area V / h. All connections are horizontal, with the width A /
    h and the distances of the generators from the face. Conductances and volumes are then those of
    the cells, for isotropic conductivity and confined flow. Raises BackendMissing without flopy.
    """
    try:
        from flopy.mf6 import MFSimulation, ModflowGwf, ModflowGwfdisu
    except ImportError as error:
        raise BackendMissing(
            "--format modflow: flopy is not installed; run: pip install 'vorolight[modflow]'"
        ) from error

    inner, count = graph.inner, len(graph.volume)
    thickness = float(np.cbrt(graph.volume.mean()))
    every = np.arange(count)
    first, second = graph.cells[:inner].T
    here, there = graph.distance[:inner].T
    cell = np.concatenate([every, first, second])
    other = np.concatenate([every, second, first])
    distance = np.concatenate([np.zeros(count), here, there])
    area = np.concatenate([np.zeros(count), graph.area[:inner], graph.area[:inner]])
    # Each cell comes before its neighbours, which are in ascending order.
    order = np.lexsort([other, other != cell, cell])
    with tempfile.TemporaryDirectory(prefix="vorolight-") as folder:
        simulation = MFSimulation(sim_ws=folder, verbosity_level=0)
        simulation.simulation_data.float_precision = DIGITS
        simulation.simulation_data.float_characters = DIGITS + 9
        ModflowGwfdisu(
            ModflowGwf(simulation, modelname="mesh"),
            nodes=count, nja=len(order), top=graph.points[:, 2] + 0.5 * thickness,
            bot=graph.points[:, 2] - 0.5 * thickness, area=graph.volume / thickness,
            iac=np.bincount(cell, minlength=count), ja=other[order],
            ihc=np.ones(len(order), np.int64), cl12=distance[order],
            hwva=area[order] / thickness, filename="mesh.disu",
        ).write()  # fmt: skip
        # The first line has the time.
        lines = (Path(folder) / "mesh.disu").read_text().split("\n", 1)
        return {"mesh.disu": lines[1].encode()}
