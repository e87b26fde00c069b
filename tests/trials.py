"""Hundreds of command lines, cheaply: a server has everything imported, and forks one a call.

The fork calls the real ``vorolight.cli.app.main``. The server itself never starts a pool of
threads, so that it can be forked; what it forks may start as many threads as it likes.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

TESTS = Path(__file__).parent
MEMORY = 6 * 2**30
"""Bytes of address space that a trial may take beyond what the libraries have."""


@dataclass(frozen=True)
class Outcome:
    """How a trial ended."""

    code: int
    """The exit code, or minus the number of the signal that ended it."""
    stdout: str
    stderr: str
    seconds: float
    rss_mb: float
    """Peak resident memory, that of the libraries included."""
    hung: bool
    operations: list[str]
    """With a fault: what it did to the file system."""

    @property
    def said(self) -> list[str]:
        """The sentences of errors, without warnings and progress."""
        return [line for line in self.stderr.splitlines() if line.startswith("vorolight: ")]

    @property
    def clean(self) -> bool:
        """Whether a failure was told in exactly one sentence."""
        return (
            len(self.said) == 1
            and "internal error" not in self.stderr
            and "Traceback" not in self.stderr
        )


class Server:
    """The process that forks; to be used in a ``with`` statement."""

    def __enter__(self) -> Self:
        self._folder = TemporaryDirectory()
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__)), "serve"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=30)
        self._folder.cleanup()

    def trial(
        self,
        words: Sequence[object],
        cwd: Path,
        *,
        fault: Mapping[str, Any] | None = None,
        signals: Sequence[tuple[float, int]] = (),
        timeout: float = 120.0,
        **more: Any,
    ) -> Outcome:
        """Run ``vorolight *words`` in ``cwd``.

        ``fault``: the fields of faults.Fault but root, which is ``cwd``, and log. ``signals``:
        seconds after the start, and which. ``more``: env, umask, and powerless for a root that may
        not do more than other users.
        """
        from faults import Fault, operations

        log = Path(self._folder.name) / "log"
        log.unlink(missing_ok=True)
        if fault is not None:
            more["fault"] = asdict(Fault(**{"root": str(cwd.resolve()), **fault, "log": str(log)}))
        answer = self._ask(
            words, cwd, signals=sorted(signals), timeout=timeout, memory=MEMORY, eager=True, **more
        )
        done = operations(log) if log.exists() else []
        return Outcome(operations=done, **answer)

    def call(
        self, words: Sequence[object], cwd: Path, env: Mapping[str, str], timeout: float = 300.0
    ) -> subprocess.CompletedProcess[str]:
        """``vorolight *words`` as users have it: with all of ``env`` and no more, with checkpoints
        as rare as they are, and with all the memory there is."""
        answer = self._ask(words, cwd, env=dict(env), timeout=timeout, whole=True)
        if answer["hung"]:
            raise subprocess.TimeoutExpired(["vorolight", *map(str, words)], timeout)
        return subprocess.CompletedProcess(
            ["vorolight", *words], answer["code"], answer["stdout"], answer["stderr"]
        )

    def _ask(self, words: Sequence[object], cwd: Path, **more: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = {"words": [*map(str, words)], "cwd": str(cwd), "out": self._folder.name, **more}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        for key, name in (("stdout", "1"), ("stderr", "2")):
            answer[key] = (Path(self._folder.name) / name).read_text(errors="replace")
        return answer


def serve() -> None:
    """Answer requests, a line of JSON each, until the other end closes."""
    _import_everything()
    answers = os.dup(1)
    os.dup2(2, 1)
    tasks = len(os.listdir("/proc/self/task"))  # noqa: PTH208
    assert tasks == 1, f"{tasks} threads: not to be forked"
    for line in sys.stdin:
        request = json.loads(line)
        pid = os.fork()
        if pid == 0:
            os.close(answers)
            _child(request)
        os.write(answers, (json.dumps(_watch(pid, request)) + "\n").encode())


def _import_everything() -> None:
    import importlib
    import pkgutil

    import numpy as np

    from vorolight import stages
    from vorolight.cli import app  # noqa: F401
    from vorolight.stages.mesh.queries.intersections import self_intersections

    for module in pkgutil.walk_packages(stages.__path__, "vorolight.stages."):
        if not module.name.endswith("_child"):
            importlib.import_module(module.name)
    for name in (
        "torch", "scipy.spatial", "scipy.sparse.linalg", "scipy.ndimage", "trimesh", "h5py",
        "manifold3d", "lib3mf", "igl", "jsonschema", "referencing", "PIL.Image", "psutil", "numba",
    ):  # fmt: skip
        importlib.import_module(name)
    # Loads the largest of the compiled loops, which would take each fork a third of a second.
    corners = np.eye(3)
    self_intersections(np.concatenate([corners, corners + 2]), np.arange(6).reshape(2, 3))


def _watch(pid: int, request: dict[str, Any]) -> dict[str, Any]:
    """Send the signals, wait, and say how it ended. Past its time the trial is killed."""
    begun, handle = time.monotonic(), os.pidfd_open(pid)
    poll = select.poll()
    poll.register(handle, select.POLLIN)

    def ended(after: float) -> bool:
        return bool(poll.poll(max(0.0, begun + after - time.monotonic()) * 1000))

    for after, number in request.get("signals", ()):
        if not ended(after):
            os.kill(pid, number)
    hung = not ended(request["timeout"])
    if hung:
        os.kill(pid, signal.SIGKILL)
    _, status, usage = os.wait4(pid, 0)
    os.close(handle)
    return {
        "code": os.waitstatus_to_exitcode(status),
        "seconds": round(time.monotonic() - begun, 3),
        "rss_mb": usage.ru_maxrss / 1024,
        "hung": hung,
    }


def _child(request: dict[str, Any]) -> None:
    """Be the trial; never returns."""
    code = 99
    try:
        code = _call(request)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _call(request: dict[str, Any]) -> int:
    import resource

    from vorolight.cli.app import main

    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for number in (1, 2):
        path = f"{request['out']}/{number}"
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(handle, number)
    os.umask(request.get("umask", 0o022))
    if request.get("whole"):
        os.environ.clear()
    os.environ.update(request.get("env", {}))
    time.tzset()
    if "memory" in request:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = used + request["memory"]
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    if request.get("eager"):
        from vorolight.stages.artifacts import checkpoints

        # However quick a run is, it shall write all its checkpoints.
        assert checkpoints.COST > 0
        checkpoints.COST = 0.0
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if "fault" in request:
        from faults import Fault, Injector

        injector = Injector(Fault(**request["fault"]))
    if request.get("powerless"):
        _drop_capabilities()
    os.chdir(request["cwd"])
    sys.argv = ["vorolight", *request["words"]]
    sys.path[0] = request["cwd"]
    if "fault" in request:
        injector.install()
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _drop_capabilities() -> None:
    """Be root by name only, for whom the files of others are those of others."""
    import ctypes

    version_3 = (ctypes.c_uint32 * 2)(0x20080522, 0)
    none = (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(version_3, none) != 0:
        raise OSError(ctypes.get_errno(), "capset")


if __name__ == "__main__" and sys.argv[1:] == ["serve"]:
    serve()
