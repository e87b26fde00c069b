"""Chamfer distance and F1 between two sets of samples (paper, appendix B.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.polygons import Floats


@dataclass(frozen=True)
class ChamferResult:
    """Squared Chamfer distance in both directions, and F1, in the frame of the points."""

    cd2: float
    f1: float
    precision: float
    recall: float
    sampling_floor: float
    """The squared distance of two independent samplings of one surface with
    area A: ``2 A / (pi N)``."""


def nearest(points: Floats, target: Floats, threads: int = 1) -> Floats:
    """The distance ``(N,)`` from each of ``points (N, 3)`` to the nearest of ``target (M, 3)``."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(target).query(points, workers=threads)[0])


def chamfer(
    predicted: Floats, reference: Floats, threshold: float, area: float, threads: int = 1
) -> ChamferResult:
    """CD^2 (equation cd2 of appendix B.1), precision, recall and F1 of two sets of samples
    ``(N, 3)``.

    ``threshold`` is the distance for F1. ``area`` is that of the surface, for the sampling floor.
    All are in one frame.
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
