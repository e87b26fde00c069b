"""The number of loss evaluations for the first surface, with Adam at several rates and with L-BFGS.

Run with ``make bench-init INPUT=bunny.obj``. All start from the same mirrored generators, with the
weights of the init stage, and compute the diagram in every evaluation.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write

from vorolight.stages import init
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.classify import Params
from vorolight.stages.engine import runner
from vorolight.stages.engine.session import Session
from vorolight.stages.init import DEFAULTS, surface_losses
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.mesh.model_frame import ModelFrame
from vorolight.stages.solvers.adam import Moments
from vorolight.stages.training.losses.shape import Distance

SHOWN = (5, 10, 20, 40)
WEIGHTS = {
    **{key: DEFAULTS["surface"][f"weight_{key}"] for key in ("shape", "normal", "area")},
    "centroid": init.Params().weight_centroid,
}

Evaluate = Callable[[np.ndarray], tuple[float, np.ndarray]]


def adam(rate: float) -> Callable[[Evaluate, np.ndarray], None]:
    def run(evaluate: Evaluate, start: np.ndarray) -> None:
        places = {"generators": torch.tensor(start)}
        moments = Moments(places)
        for iteration in range(max(SHOWN) + 1):
            _, gradient = evaluate(places["generators"].numpy())
            moments.step([torch.tensor(gradient)], iteration, rate)

    return run


def lbfgs(evaluate: Evaluate, start: np.ndarray) -> None:
    from scipy.optimize import minimize

    def flat(places: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = evaluate(places.reshape(-1, 3))
        return value, gradient.reshape(-1)

    minimize(
        flat, start.reshape(-1), jac=True, method="L-BFGS-B",
        options={"maxfun": max(SHOWN), "maxcor": 20, "ftol": 0.0, "gtol": 0.0},
    )  # fmt: skip


METHODS = {
    "Adam 0.005": adam(0.005),
    "Adam 0.01 (init)": adam(0.01),
    "Adam 0.02": adam(0.02),
    "L-BFGS": lbfgs,
}


def study(shape: str, n: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        session = Session(RunFolder(Path(folder) / "run"), identify(shape))
        runner.execute(session, "classify", Params(n_init=n))
        runner.execute(session, "init", init.Params(iterations=0))
        frame = ModelFrame.of(session.folder.arrays("classify", "classify"))
        arrays = session.folder.arrays("init", "init")
    start, inside = frame.model_from_input(arrays["generators"]), arrays["generator_inside"]
    shape_loss = Distance(identify(shape).open().true_surface(frame, session.threads))
    found: dict[str, Any] = {}
    for name, method in METHODS.items():
        seen: list[list[float]] = []

        def evaluate(places: np.ndarray, seen: list[list[float]] = seen) -> Any:
            at = torch.tensor(places, requires_grad=True)
            terms = surface_losses(at, inside, shape_loss)
            total = sum(WEIGHTS[key] * terms[key] for key in WEIGHTS)
            (gradient,) = torch.autograd.grad(total, at)
            seen.append(
                [
                    float(total.detach()),
                    float(terms["shape"].detach()),
                    float(terms["normal"].detach()),
                ]
            )
            return float(total.detach()), gradient.numpy()

        begin = time.perf_counter()
        method(evaluate, start)
        values = np.array(seen)
        # A line search also evaluates points that it does not take, so that the best one counts.
        best = np.array([np.argmin(values[: count + 1, 0]) for count in range(len(values))])
        found[name] = {
            "seconds_an_evaluation": round((time.perf_counter() - begin) / len(values), 3),
            **{
                str(count): dict(
                    zip(("total", "shape", "normal"), values[best[count]].round(6), strict=True)
                )
                for count in (0, *SHOWN)
                if count < len(values)
            },
        }
        print(shape, name, found[name], flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shapes", nargs="+")
    parser.add_argument("-n", type=int, default=25)
    given = parser.parse_args()
    write("first_surface", {Path(shape).stem: study(shape, given.n) for shape in given.shapes})


if __name__ == "__main__":
    main()
