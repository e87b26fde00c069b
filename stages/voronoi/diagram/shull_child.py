"""Delaunay tetrahedra by shull, which is under the GPL.

Only the child process that this module starts imports shull.
"""

from __future__ import annotations

import subprocess
import sys
from typing import IO

import numpy as np
from numpy.typing import NDArray

HEADER = 8
"""Size of a count in bytes. A count of -1 announces an error message."""

_CHILD: list[subprocess.Popen[bytes]] = []


def tetrahedra(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Corners and neighbours ``(T, 4)`` of the tetrahedra of ``points (N, 3)``.

    The child process is kept for the next call. Raises RuntimeError if shull fails or ends.
    """
    child = _CHILD.pop() if _CHILD else _started()
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        _send(child.stdin, len(points), np.ascontiguousarray(points, dtype=np.float64))
        count = _count(child.stdout)
        size = 16 * count if count >= 0 else _count(child.stdout)
        answer = [_read(child.stdout, size) for _ in range(2 if count >= 0 else 1)]
    except (EOFError, OSError) as error:
        child.kill()
        raise RuntimeError(f"shull ended with {child.wait()}") from error
    # The child is kept only after a whole answer was read; otherwise the next call would read the
    # rest of this one.
    _CHILD.append(child)
    if count < 0:
        raise RuntimeError(answer[0].decode())
    corners, neighbours = (np.frombuffer(part, np.int32).reshape(-1, 4) for part in answer)
    return corners.astype(np.int64), neighbours.astype(np.int64)


def _started() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


def _send(pipe: IO[bytes], count: int, *parts: NDArray[np.generic]) -> None:
    pipe.write(count.to_bytes(HEADER, "little", signed=True))
    for part in parts:
        pipe.write(part.tobytes())
    pipe.flush()


def _count(pipe: IO[bytes]) -> int:
    return int.from_bytes(_read(pipe, HEADER), "little", signed=True)


def _read(pipe: IO[bytes], size: int) -> bytes:
    """Exactly ``size`` bytes. Raises EOFError if the other process ends before that."""
    found = pipe.read(size)
    if len(found) < size:
        raise EOFError
    return found


def _serve() -> None:
    """Answer requests until the pipe is closed."""
    import shull

    into, out = sys.stdin.buffer, sys.stdout.buffer
    while True:
        try:
            points = np.frombuffer(_read(into, 24 * _count(into))).reshape(-1, 3)
        except EOFError:
            return
        try:
            found = shull.Delaunay(points)
            parts = [np.ascontiguousarray(a, np.int32) for a in (found.simplices, found.neighbors)]
        # A panic of the Rust code derives from BaseException.
        except BaseException as error:
            text = np.frombuffer(f"shull: {error}".encode(), np.uint8)
            out.write((-1).to_bytes(HEADER, "little", signed=True))
            _send(out, len(text), text)
        else:
            _send(out, len(parts[0]), *parts)


if __name__ == "__main__":
    _serve()
