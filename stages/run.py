"""A whole run in one call from Python: from a shape to its surface, cells and printable object."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .artifacts import atomic
from .artifacts.run_folder import RunFolder
from .engine import registry, runner
from .engine.params import StageParams
from .engine.session import Session, available_threads
from .errors import ArtifactError, Stopped, UsageError
from .inputs.resolve import Identity, identify
from .progress import Silent

if TYPE_CHECKING:
    from .artifacts.manifest import Manifest
    from .mesh.dual_graph import DualGraph
    from .mesh.polygons import Floats, PolygonMesh
    from .mesh.polyhedra import PolyhedralMesh
    from .voronoi.trained_surface import TrainedSurface

Callback = Callable[[str, str, float], bool | None]
"""Called with the stage, what it does now, and the share of that which is done. False stops it."""
SURFACES = ("sphere-train", "init")
"""Stages that write a surface, the later one first."""


@dataclass(frozen=True)
class Run:
    """What a run left in its ``folder``. Lengths are in the units of the input."""

    folder: Path
    _lent: Any = field(default=None, repr=False)
    """Keeps a temporary folder until the run is no longer used."""

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """What each finished stage measured, by the name of its files (``evaluate-init``, ...)."""
        return {name: dict(stored["metrics"]) for name, stored in self.manifests.items()}

    @property
    def warnings(self) -> dict[str, list[str]]:
        """The warnings of each finished stage."""
        return {name: list(stored["warnings"]) for name, stored in self.manifests.items()}

    @cached_property
    def manifests(self) -> dict[str, Manifest]:
        """The manifest of each finished stage, by the name of its files."""
        stems = sorted(path.stem for path in self.folder.glob("*.json"))
        found = {stem: RunFolder(self.folder).manifest(stem) for stem in stems}
        return {stem: stored for stem, stored in found.items() if stored is not None}

    def arrays(self, stem: str) -> dict[str, Any]:
        """All arrays of the HDF5 file of a finished stage, by their names there.

        Raises ArtifactError if it is not finished or was changed since.
        """
        stage = self.manifests[stem]["stage"] if stem in self.manifests else stem
        return dict(RunFolder(self.folder).arrays(stem, stage))

    @cached_property
    def surface(self) -> PolygonMesh:
        """The surface of the last stage that writes one: stage sphere-train, else stage init."""
        from .mesh.polygons import PolygonMesh

        return PolygonMesh.from_arrays(self.arrays(self._latest), "surface/")

    @cached_property
    def generators(self) -> tuple[Floats, Floats]:
        """The generators inside and outside of each face of ``surface``, ``(F, 3)`` each."""
        arrays = self.arrays(self._latest)
        inside, outside = arrays["surface/face_generators"].T
        if self._latest == "init":
            return arrays["generators"][inside], arrays["generators"][outside]
        return arrays["generators/inside"][inside], arrays["generators/outside"][outside]

    @cached_property
    def trained(self) -> TrainedSurface:
        """Spheres, polygons and pairs of generators of stage sphere-train, in the units of the
        input. Raises ArtifactError if it is not done."""
        from .mesh.model_frame import ModelFrame
        from .voronoi.trained_surface import TrainedSurface

        return TrainedSurface.stored(self.arrays("sphere-train"), ModelFrame(np.zeros(3), 1.0))

    @cached_property
    def cells(self) -> PolyhedralMesh:
        """The polyhedral cells of stage volume. Raises ArtifactError if it is not done."""
        from .mesh.polyhedra import PolyhedralMesh

        return PolyhedralMesh.from_arrays(self.arrays("volume"))

    @cached_property
    def graph(self) -> DualGraph:
        """The connections of ``cells`` for finite volumes with two points a face."""
        from .mesh.dual_graph import DualGraph

        arrays = self.arrays("volume")
        points = arrays["generators"][self.cells.cell_generator]
        return DualGraph.of(self.cells, points, arrays["cell_volume"])

    def trimesh(self) -> Any:
        """``surface`` as a trimesh.Trimesh; its polygons are divided into triangles."""
        import trimesh

        from .mesh.geometry import fan_triangles

        vertices, triangles, _ = fan_triangles(self.surface)
        return trimesh.Trimesh(vertices, triangles, process=False)

    @property
    def _latest(self) -> str:
        for name in SURFACES:
            if name in self.manifests:
                return name
        raise ArtifactError(f"{self.folder}: no stage with a surface is done")


def run(
    shape: Any,
    n: int | None = None,
    *,
    until: str = "sphere-train",
    folder: str | Path | None = None,
    kind: str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callback | None = None,
    **options: Mapping[str, Any] | StageParams,
) -> Run:
    """Run all stages up to ``until`` on a shape, as ``vorolight run`` does, with the same bytes.

    ``shape`` is a path or the name of a field, as INPUT of the command line; a mesh as an object
    with ``vertices`` and ``faces`` (trimesh), as VTK's polygon data (pyvista), or as a tuple
    ``(vertices (V, 3), faces (F, k))``; points ``(N, 3)``; or samples of a field on a grid
    ``(X, Y, Z)``, negative inside. An object is written into the run folder first.

    ``folder`` is the run folder: by default that of the command line for a path or a name, and a
    temporary one, which is deleted with the result, for anything else. ``n`` is the number of
    voxels along the longest side. ``progress`` is called with the stage, what it does and the share
    of that which is done; where it returns False, Stopped is raised, and the same call goes on from
    the last checkpoint. The options of a stage are a mapping under its name, with ``_`` for ``-``::

        run("bunny.obj", n=25, until="volume", sphere_train={"faces": "polygon"},
            volume={"inner": 800})

    Raises the exceptions of ``vorolight.stages.errors``, each with the sentence that the command
    line prints.
    """
    lent = None
    given = None if folder is None else Path(folder)
    if isinstance(shape, str | Path):
        source = identify(str(shape), kind)
        place = RunFolder.locate(given, source.stem)
    else:
        if given is None:
            lent = tempfile.TemporaryDirectory(prefix="vorolight-")
            given = Path(lent.name)
        place = RunFolder(given)
        source = _written(shape, given, kind)
    names = registry.stages_until(until, source.kind)
    planned = _planned(names, n, options)
    session = Session(
        folder=place,
        input=source,
        seed=seed,
        threads=threads or available_threads(),
        progress=Silent() if progress is None else _Reported(progress),
    )
    for name in names:
        if isinstance(session.progress, _Reported):
            session.progress.stage = name
        runner.execute(session, name, planned[name])
    return Run(place.path, lent)


def _planned(
    names: list[str], n: int | None, options: Mapping[str, Mapping[str, Any] | StageParams]
) -> dict[str, StageParams]:
    """The StageParams of each stage. Raises UsageError for an unknown stage or option."""
    given = {key.replace("_", "-"): value for key, value in options.items()}
    for name in given:
        if name not in names:
            raise UsageError(
                f"{name}: is not a stage of this run; its stages are {', '.join(names)}"
            )
    planned = {}
    for name in names:
        wanted = given.get(name, {})
        if isinstance(wanted, Mapping):
            own = {key.replace("-", "_"): value for key, value in wanted.items()}
            if name == "classify" and n is not None:
                own.setdefault("n_init", n)
            wanted = _params(name, own)
        planned[name] = wanted
    return planned


def _params(name: str, values: Mapping[str, Any]) -> StageParams:
    from .engine.params import options

    stage = registry.get(name)
    known = {option.name for option in options(stage.params)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise UsageError(
            f"{name}: {unknown[0]} is not one of its options: {', '.join(sorted(known))}"
        )
    return stage.params(**values)


def _written(shape: Any, folder: Path, kind: str | None) -> Identity:
    """``shape`` as a file in the run folder."""
    mesh = _as_mesh(shape)
    if mesh is not None:
        from .formats import ply

        path, data = folder / "input.ply", ply.encode(mesh)
    else:
        import io

        values = np.asarray(shape)
        if values.dtype.kind not in "fiu" or values.ndim not in (2, 3):
            raise UsageError(
                f"shape: a {type(shape).__name__} is not a path, a mesh, (N, 3) points "
                "or (X, Y, Z) samples; give one of these"
            )
        buffer = io.BytesIO()
        np.save(buffer, values, allow_pickle=False)
        path, data = folder / "input.npy", buffer.getvalue()
    atomic.make_folder(folder)
    if not path.is_file() or path.read_bytes() != data:
        atomic.write(path, data)
    return identify(str(path), kind)


def _as_mesh(shape: Any) -> PolygonMesh | None:
    """The polygons of a mesh of another library, or of ``(vertices, faces)``, if it is one."""
    from .mesh.polygons import PolygonMesh

    if isinstance(shape, PolygonMesh):
        return shape
    if hasattr(shape, "GetPolys"):
        from vtkmodules.util import numpy_support

        to_numpy: Any = numpy_support.vtk_to_numpy
        polygons = shape.GetPolys()
        return PolygonMesh(
            to_numpy(shape.GetPoints().GetData()).astype(np.float64),
            to_numpy(polygons.GetOffsetsArray()).astype(np.int64),
            to_numpy(polygons.GetConnectivityArray()).astype(np.int64),
        )
    if isinstance(shape, tuple) and len(shape) == 2:
        vertices, faces = shape
    elif hasattr(shape, "vertices") and hasattr(shape, "faces"):
        vertices, faces = shape.vertices, shape.faces
    else:
        return None
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2:
        raise UsageError("shape: a mesh needs vertices (V, 3) and faces (F, k) of vertex numbers")
    if faces.dtype.kind not in "iu" or faces.min(initial=0) < 0 or faces.max() >= len(vertices):
        raise UsageError("shape: faces (F, k) must be numbers of vertices, from 0")
    return PolygonMesh.of_triangles(vertices, faces)


class _Reported(Silent):
    """Progress that is told to a function, which may stop the run."""

    def __init__(self, tell: Callback) -> None:
        self.tell, self.stage, self.label, self.total = tell, "", "", 0

    def start(self, label: str, total: int) -> None:
        self.label, self.total = label, total
        self.advance(0)

    def advance(self, done: int, note: str = "") -> None:
        share = 1.0 if self.total == 0 else min(done / self.total, 1.0)
        if self.tell(self.stage, self.label, share) is False:
            raise Stopped("stopped by its caller; the same call continues from the last checkpoint")
