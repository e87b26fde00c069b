"""Chamfer distance and F1 between two sample sets (paper's appendix B.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.polygons import Floats


@dataclass(frozen=True)
class ChamferResult:
    """Squared bidirectional Chamfer distance and F1, in the frame the points were given in."""

    cd2: float
    f1: float
    precision: float
    recall: float
    sampling_floor: float
    """The value for two independent samplings of one surface: ``2 A / (pi N)``."""


def nearest(points: Floats, target: Floats, threads: int = 1) -> Floats:
    """Distance from each of ``points (N, 3)`` to the nearest of ``target (M, 3)``."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(target).query(points, workers=threads)[0])


def chamfer(
    predicted: Floats, reference: Floats, threshold: float, area: float, threads: int = 1
) -> ChamferResult:
    """CD^2 (eq. cd2), precision, recall and F1 at ``threshold`` of two ``(N, 3)`` sample sets.

    ``area`` is the surface's, in the same frame, for the sampling floor.
    """
    forward = nearest(predicted, reference, threads)
    backward = nearest(reference, predicted, threads)
    precision = float((forward < threshold).mean())
    recall = float((backward < threshold).mean())
    return ChamferResult(
        cd2=float((forward**2).mean() + (backward**2).mean()),
        f1=2 * precision * recall / (precision + recall + 1e-12),
        precision=precision,
        recall=recall,
        sampling_floor=2 * area / (np.pi * len(reference)),
    )
