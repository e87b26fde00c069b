"""Checks of the installation: versions against the declared bounds, and one real use of each
library."""

from __future__ import annotations

import importlib.util
import platform
import re
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from .finding import Finding

ENABLES = {
    "fast": "--backend shull, faster diagrams",
    "render": "fabricate --render as a path-traced picture",
    "images": "pictures of phones (HEIC)",
    "scans": "point clouds in LAS, LAZ and E57",
    "modflow": "cells as a grid of MODFLOW 6",
    "cluster": "tables as .parquet, workflows on many machines",
}
"""The purpose of each extra; extras for developers are left out."""


def python(folder: Path) -> Iterator[Finding]:
    about = metadata.metadata("vorolight")
    here, least = platform.python_version(), about["Requires-Python"].removeprefix(">=")
    name = f"{here} ({platform.python_implementation()}, {platform.platform(terse=True)})"
    if release(here) < release(least):
        yield Finding("python", name, "problem", f"install Python {least} or newer")
    else:
        yield Finding("python", name)
    yield Finding("vorolight", f"{about['Version']} in {Path(__file__).parents[3]}")


def release(version: str) -> tuple[int, ...]:
    """The numbers that a version begins with."""
    found = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in found[0].split(".")) if found else ()


def requirements(extra: str | None) -> list[tuple[str, str]]:
    """Names and lowest versions of the declared dependencies, or of those of ``extra``."""
    found = []
    for text in metadata.requires("vorolight") or []:
        wanted, _, marker = text.partition(";")
        named = re.search(r"extra == ['\"]([^'\"]+)", marker)
        if (named[1] if named else None) == extra:
            name, _, least = wanted.partition(">=")
            found.append((name.strip(), least.strip()))
    return found


def libraries(folder: Path) -> Iterator[Finding]:
    for name, least in requirements(None):
        there = _version(name)
        advice = f"run: pip install --upgrade '{name}>={least}'"
        if there is None:
            yield Finding(name, f"not installed (>= {least})", "problem", advice)
        elif release(there) < release(least):
            yield Finding(name, f"{there}, older than {least}", "problem", advice)
        else:
            yield Finding(name, f"{there} (>= {least})")


def extras(folder: Path) -> Iterator[Finding]:
    for extra, purpose in ENABLES.items():
        said, lacking = [], not requirements(extra)
        for name, least in requirements(extra):
            there = _version(name)
            lacking |= there is None or release(there) < release(least)
            said.append(f"{name} {there or 'not installed'}")
        found = f"{', '.join(said)}: {purpose}"
        advice = f"to use it, run: pip install --upgrade 'vorolight[{extra}]'"
        yield Finding(
            f"extra {extra}", found, "note" if lacking else "ok", advice if lacking else None
        )


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def delaunay(folder: Path) -> Iterator[Finding]:
    import numpy as np

    from ...voronoi.diagram.delaunay import BACKENDS

    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    points = np.concatenate([corners, np.random.default_rng(0).uniform(0, 1, (40, 3))])
    for name, tetrahedra in BACKENDS.items():
        if importlib.util.find_spec(name) is None:
            yield Finding(f"Delaunay by {name}", "not installed", "note", "see extra fast")
            continue
        found = points[tetrahedra(points)[0]]
        volume = np.abs(np.linalg.det(found[:, 1:] - found[:, :1])).sum() / 6
        _expect(abs(volume - 1) < 1e-9, f"{name}: tetrahedra of a cube have volume {volume}")
        yield Finding(f"Delaunay by {name}", f"{len(found)} tetrahedra fill a cube")


def _expect(holds: bool, otherwise: str) -> None:
    if not holds:
        raise RuntimeError(otherwise)


def _mean(values: Any) -> float:
    total = 0.0
    for value in values:
        total += value
    return total / len(values)


def kernels(folder: Path) -> Iterator[Finding]:
    """Compile a loop, and remove what that leaves in the cache."""
    import numpy as np

    from ...compiled import compiled

    began = time.perf_counter()
    kernel: Any = compiled(_mean)
    _expect(kernel(np.arange(5.0)) == 2.0, "a compiled loop computes a wrong mean")
    took = f"compiled in {time.perf_counter() - began:.1f} s"
    place = kernel.stats.cache_path
    if place is None:
        advice = "set NUMBA_CACHE_DIR to a folder that can be written to"
        yield Finding(
            "compiled loops", f"{took}, not stored: every process compiles again", "note", advice
        )
        return
    kept = [*Path(place).glob(f"{Path(__file__).stem}.{_mean.__name__}-*")]
    for file in kept:
        file.unlink(missing_ok=True)
    _expect(bool(kept), f"{place}: no compiled loop was stored")
    yield Finding("compiled loops", f"{took}, stored in {place}")


def torch_operations(folder: Path) -> Iterator[Finding]:
    """Check operations of the training in the mode that gives the same bits every time."""
    import torch

    from ... import torch_start
    from ..session import available_threads

    torch_start.start(available_threads())
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(20_000, dtype=torch.float64, generator=generator).requires_grad_()
    index = torch.randint(0, 50, (20_000,), generator=generator)
    made = []
    for _ in range(3):
        total = torch.zeros(50, dtype=torch.float64).index_add(0, index, values**2)
        made.append(torch.cat([total, *torch.autograd.grad(torch.sin(total).sum(), values)]))
    _expect(
        all(torch.equal(made[0], other) for other in made),
        "repeated operations give different bits",
    )
    _expect(bool((made[0][50:] != 0).any()), "gradients are missing")
    yield Finding("torch operations", f"repeat their bits, {torch.get_num_threads()} threads")


def distances(folder: Path) -> Iterator[Finding]:
    import igl
    import numpy as np

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    square = igl.point_mesh_squared_distance(
        np.array([[0.2, 0.2, 2.0]]), corners, np.array([[0, 1, 2]])
    )
    _expect(abs(square[0][0] - 4) < 1e-12, f"libigl: a distance of 2 has the square {square[0]}")
    yield Finding("distances", "libigl measures")


def solids(folder: Path) -> Iterator[Finding]:
    from manifold3d import Manifold

    hollow = Manifold.cube((2.0, 2.0, 2.0), True) - Manifold.cube((1.0, 1.0, 1.0), True)
    _expect(abs(hollow.volume() - 7) < 1e-6, f"a hollow cube has volume {hollow.volume()}")
    yield Finding("solids", "manifold3d subtracts")


def threemf(folder: Path) -> Iterator[Finding]:
    import numpy as np

    from ...formats.threemf import Body, encode, read

    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    found = read(encode([Body("tetrahedron", corners, faces)], "doctor", "vorolight"))
    _expect(len(found) == 1 and len(found[0].triangles) == 4, "3MF does not read back as written")
    yield Finding("3MF", "lib3mf writes and reads")


def hdf5(folder: Path) -> Iterator[Finding]:
    import io

    import h5py
    import numpy as np

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        file.create_dataset("a", data=np.arange(100.0), compression="gzip")
    with h5py.File(memory, "r") as file:
        _expect(float(file["a"][99]) == 99.0, "HDF5 does not read back as written")
    yield Finding("HDF5", f"h5py writes and reads, library {h5py.version.hdf5_version}")


def repair(folder: Path) -> Iterator[Finding]:
    """Repair with pymeshlab, in its own child process: it must close a tetrahedron that lacks a
    face."""
    import numpy as np

    from ...inputs.mesh.repair_child import repaired
    from ...mesh.polygons import PolygonMesh

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    opened = PolygonMesh.of_triangles(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3]]))
    faces = len(repaired(opened, "a tetrahedron without a face").face_offsets) - 1
    _expect(faces == 4, f"--repair makes {faces} faces of a tetrahedron")
    yield Finding("mesh repair", "pymeshlab closes a hole, in a process of its own")
