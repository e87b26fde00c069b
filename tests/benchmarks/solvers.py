"""The linear systems of Gauss-Newton steps, solved by conjugate gradients and by factorisation.

Run with ``make bench-solvers INPUT=bunny.obj``. The systems are from the middle of a training of
triangles and of a training of polygons. Quality is the decrease that a step promises, divided by
that of the exact step.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cholespy
import numpy as np
from results import write
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from vorolight.stages import classify, init, sphere_train
from vorolight.stages.artifacts.run_folder import RunFolder
from vorolight.stages.engine import runner
from vorolight.stages.engine.session import Session
from vorolight.stages.inputs.resolve import identify
from vorolight.stages.solvers.gauss_newton import descend
from vorolight.stages.solvers.least_squares import ITERATIONS, TOLERANCE, GaussNewton
from vorolight.stages.training import conforming, polygons

SEEN = {"triangle": 12, "polygon": 10}
"""The number of the step from which the system is taken."""


class Captured(Exception):
    """Raised when the system has been captured."""


def system(shape: str, n: int, faces: str) -> tuple[GaussNewton, float]:
    """A system of a training, and its damping."""
    module = conforming if faces == "triangle" else polygons
    steps = 0
    found: list[tuple[GaussNewton, float]] = []

    def spied(problem: Any, state: Any, factors: list[float], damping: float) -> Any:
        nonlocal steps
        losses = []
        for factor in factors:
            steps += 1
            if steps == SEEN[faces]:
                problem.prepare(state, factor)
                blocks = problem.blocks(state, problem.residuals(state))
                found.append((GaussNewton(blocks, problem.free), damping))
                raise Captured
            state, loss, damping = descend(problem, state, [factor], damping)
            losses.append(loss)
        return state, np.concatenate(losses), damping

    with tempfile.TemporaryDirectory() as folder:
        session = Session(RunFolder(Path(folder) / "run"), identify(shape))
        runner.execute(session, "classify", classify.Params(n_init=n))
        runner.execute(session, "init", init.Params())
        module.descend = spied
        try:
            runner.execute(session, "sphere-train", sphere_train.Params(faces=faces))
        except Captured:
            return found[0]
        finally:
            module.descend = descend
    raise SystemExit(f"{shape}: the training had no such step")


def study(shape: str, n: int, faces: str) -> dict[str, Any]:
    problem, damping = system(shape, n, faces)
    jacobian, gradient, squares = problem._system
    transpose = jacobian.T.tocsr()
    shift = damping * squares.mean()
    count = len(gradient)

    def by_scipys_cg() -> np.ndarray:
        size = (count, count)
        return cg(
            LinearOperator(size, lambda x: transpose @ (jacobian @ x) + shift * x, dtype=float),
            -gradient, rtol=TOLERANCE, maxiter=ITERATIONS,
            M=LinearOperator(size, lambda x: x / (squares + shift), dtype=float),
        )[0]  # fmt: skip

    def normal() -> Any:
        return (csr_array(transpose @ jacobian) + shift * eye_array(count)).tocsc()

    def by_cholesky() -> np.ndarray:
        matrix = normal()
        solver = cholespy.CholeskySolverD(
            count, matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data,
            cholespy.MatrixType.CSC,
        )  # fmt: skip
        result = np.zeros(count)
        solver.solve(-gradient, result)
        return result

    def by_splu() -> np.ndarray:
        options = {"SymmetricMode": True}
        found = splu(normal(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return found.solve(-gradient)

    def promised(x: np.ndarray) -> float:
        return float(-(gradient @ x) - 0.5 * (np.sum((jacobian @ x) ** 2) + shift * x @ x))

    methods: dict[str, Callable[[], np.ndarray]] = {
        "conjugate gradients (used)": lambda: problem.step(damping)[problem.free],
        "conjugate gradients (scipy)": by_scipys_cg,
        "Cholesky (cholespy)": by_cholesky,
        "LU (scipy, SuperLU)": by_splu,
    }
    problem.step(damping)  # starts threads and assembles the system
    steps, seconds = {}, {}
    for name, method in methods.items():
        begin = time.perf_counter()
        steps[name] = promised(method())
        seconds[name] = round(time.perf_counter() - begin, 3)
    exact = steps["Cholesky (cholespy)"]
    row = {
        "shape": Path(shape).stem,
        "n": n,
        "faces": faces,
        "unknowns": count,
        "entries": int(jacobian.nnz),
        "methods": {
            name: {"seconds": seconds[name], "of_the_exact_decrease": round(steps[name] / exact, 5)}
            for name in methods
        },
    }
    print(row, flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape")
    parser.add_argument("-n", type=int, nargs="+", default=[25])
    given = parser.parse_args()
    write("solvers", [study(given.shape, n, faces) for n in given.n for faces in SEEN])


if __name__ == "__main__":
    main()
