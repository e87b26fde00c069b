"""Damaged input files: one clear sentence, soon, and within bounds."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from input_files import seeds

from vorolight.stages.errors import InputError

SECONDS, MEMORY_MB = 10.0, 2000.0
"""What opening one file may take."""


def _truncated(raw: bytearray, random: np.random.Generator) -> bytearray:
    return raw[: random.integers(len(raw))]


def _flipped(raw: bytearray, random: np.random.Generator) -> bytearray:
    for place in random.integers(len(raw), size=random.integers(1, 20)):
        raw[place] ^= 1 << int(random.integers(8))
    return raw


def _flipped_early(raw: bytearray, random: np.random.Generator) -> bytearray:
    for place in random.integers(min(len(raw), 300), size=3):
        raw[place] = int(random.integers(256))
    return raw


def _huge_counts(raw: bytearray, random: np.random.Generator) -> bytearray:
    huge = [b"999999999", b"4294967295", b"-1", b"18446744073709551615", b"0"]
    digits = [i for i, c in enumerate(raw[:600]) if chr(c).isdigit()]
    if not digits:
        return raw
    start = end = int(random.choice(digits))
    while start and chr(raw[start - 1]).isdigit():
        start -= 1
    while end < len(raw) and chr(raw[end]).isdigit():
        end += 1
    return raw[:start] + huge[random.integers(len(huge))] + raw[end:]


def _huge_words(raw: bytearray, random: np.random.Generator) -> bytearray:
    place = int(random.integers(max(1, min(len(raw) - 8, 400))))
    raw[place : place + 4] = b"\xff\xff\xff\x7f"
    return raw


def _not_numbers(raw: bytearray, random: np.random.Generator) -> bytearray:
    words = [b"nan", b"inf", b"-inf", b"1e999", b"x", b""]
    parts = raw.split(b" ")
    for place in random.integers(len(parts), size=5):
        parts[place] = bytearray(words[random.integers(len(words))])
    if len(parts) > 20:
        return bytearray(b" ".join(parts))
    place = int(random.integers(max(1, len(raw) - 8)))
    raw[place : place + 8] = np.array([np.nan, np.inf][place % 2]).tobytes()
    return raw


def _swapped(raw: bytearray, random: np.random.Generator) -> bytearray:
    start = int(random.integers(min(len(raw), 200)))
    rest = raw[start:]
    whole = len(rest) // 4 * 4
    turned = np.frombuffer(bytes(rest[:whole]), "<u4").byteswap().tobytes()
    return raw[:start] + turned + rest[whole:]


def _short_lines(raw: bytearray, random: np.random.Generator) -> bytearray:
    """A few lines only, or some of them twice."""
    lines = raw.split(b"\n")
    kept = sorted(random.integers(len(lines), size=random.integers(1, 8)))
    return bytearray(b"\n".join(lines[i] for i in kept))


DAMAGES: list[Callable[[bytearray, np.random.Generator], bytearray]] = [
    _truncated, _flipped, _flipped_early, _huge_counts, _huge_words, _not_numbers, _swapped,
    _short_lines,
]  # fmt: skip


def damaged(folder: Path, count: int) -> Iterator[tuple[str, Path]]:
    """Files with ``count`` damages each, and what is wrong with them."""
    for number, seed in enumerate(seeds(folder)):
        raw = seed.read_bytes()
        for case in range(count):
            random = np.random.default_rng([number, case])
            damage = DAMAGES[case % len(DAMAGES)]
            path = folder / f"damaged{''.join(seed.suffixes)}"
            path.write_bytes(bytes(damage(bytearray(raw), random)))
            yield f"{seed.name} {damage.__name__} {case}", path


def open_all(folder: str, count: int) -> None:
    """Open every damaged file; print what went wrong, and the worst of time and memory."""
    import resource
    import time

    from vorolight.stages.inputs.field.source import FieldSource
    from vorolight.stages.inputs.mesh.source import MeshSource
    from vorolight.stages.inputs.points.source import PointSource
    from vorolight.stages.inputs.resolve import identify

    faults, opened, slowest, cases = [], 0, 0.0, 0
    for name, path in damaged(Path(folder), count):
        cases += 1
        start = time.perf_counter()
        try:
            source = identify(str(path)).open()
            if isinstance(source, FieldSource):
                source.bounding_box()
            elif isinstance(source, PointSource):
                _ = source.cloud
            elif isinstance(source, MeshSource):
                source.topology()
            opened += 1
        except InputError as error:
            if str(path) not in str(error) or "\n" in str(error):
                faults.append(f"{name}: says {error}")
        except BaseException as error:
            faults.append(f"{name}: {type(error).__name__} {error}"[:300])
        slowest = max(slowest, time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"cases": cases, "opened": opened, "faults": faults, "slowest": slowest,
                      "peak_mb": peak}))  # fmt: skip


def _opened(folder: Path, count: int) -> dict[str, object]:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_fuzz; "
    code += f"test_fuzz.open_all({str(folder)!r}, {count})"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True,
                          text=True, timeout=3000)  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _check(found: dict[str, object]) -> None:
    assert found["faults"] == []
    assert float(str(found["slowest"])) < SECONDS
    assert float(str(found["peak_mb"])) < MEMORY_MB
    # Some damages do no harm; if all files opened, none would have been damaged.
    assert 0 < int(str(found["opened"])) < int(str(found["cases"]))


def test_a_few_damaged_files(tmp_path: Path) -> None:
    _check(_opened(tmp_path, 8))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_damaged_files(tmp_path: Path) -> None:
    found = _opened(tmp_path, 60)
    assert int(str(found["cases"])) >= 2000
    _check(found)
