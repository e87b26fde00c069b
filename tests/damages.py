"""What may befall the files of a run: rot, mix-ups, strange JSON, links to elsewhere."""

from __future__ import annotations

import copy
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

Bytes = Callable[[bytes, random.Random], bytes]
Change = Callable[[dict[str, Any], random.Random], object]


def _flipped(data: bytes, dice: random.Random) -> bytes:
    raw = bytearray(data)
    for _ in range(dice.randint(1, 20)):
        raw[dice.randrange(len(raw))] ^= 1 << dice.randrange(8)
    return bytes(raw)


def _zeroed(data: bytes, dice: random.Random) -> bytes:
    begin, count = dice.randrange(len(data)), dice.choice((16, 512, 4096))
    return data[:begin] + bytes(len(data[begin : begin + count])) + data[begin + count :]


BYTES: dict[str, Bytes] = {
    "truncated": lambda data, dice: data[: dice.randrange(1, len(data))],
    "bits flipped": _flipped,
    "block zeroed": _zeroed,
    "emptied": lambda data, dice: b"",
    "bytes appended": lambda data, dice: data + dice.randbytes(dice.randint(1, 999)),
}

Leaf = tuple[Any, Any]
"""What holds a value, and its key or number there."""


def _leaves(value: Any) -> list[Leaf]:
    keys = value.items() if isinstance(value, dict) else enumerate(value)
    found: list[Leaf] = []
    for key, item in keys:
        if key in ("volatile", "checksum"):
            continue
        found += _leaves(item) if isinstance(item, (dict, list)) and item else [(value, key)]
    return found


def _set(found: list[Leaf], dice: random.Random, value: Callable[[Any], Any]) -> None:
    holder, key = dice.choice(found)
    holder[key] = value(holder[key])


def _numbers(record: Any) -> list[Leaf]:
    return [
        (holder, key)
        for holder, key in _leaves(record)
        if isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool)
    ]


def _drop(record: dict[str, Any], dice: random.Random) -> None:
    holder, key = dice.choice([leaf for leaf in _leaves(record) if isinstance(leaf[0], dict)])
    del holder[key]


def _output(path: str) -> Change:
    def change(record: dict[str, Any], dice: random.Random) -> None:
        dice.choice(record["outputs"])["path"] = path

    return change


VALUES: dict[str, Change] = {
    "number changed": lambda record, dice: _set(
        _numbers(record), dice, lambda old: dice.choice((old + 1, -1, 0, 1e300, 2**62))
    ),
    "huge integer": lambda record, dice: _set(_numbers(record), dice, lambda old: 10**400),
    "string for a number": lambda record, dice: _set(_numbers(record), dice, str),
    "list for a value": lambda record, dice: _set(_leaves(record), dice, lambda old: [old]),
    "object for a value": lambda record, dice: _set(_leaves(record), dice, lambda old: {"a": old}),
    "null for a value": lambda record, dice: _set(_leaves(record), dice, lambda old: None),
    "key missing": _drop,
    "output path ..": _output(".."),
    "output path ../x": _output("../outside"),
    "output path absolute": _output("/etc/hostname"),
    "output path a manifest": _output("classify.json"),
    "input path elsewhere": lambda record, dice: (
        record["inputs"][0].update(
            path=dice.choice(("/dev/zero", "/proc/self/mem", ".", "../outside", "\0"))
        )
        if record["inputs"]
        else record.update(inputs=[])
    ),
    "newer schema": lambda record, dice: record.update(
        schema=record["schema"].replace(":manifest:1:", ":manifest:2:")
    ),
    "another stage's name": lambda record, dice: record.update(stage=dice.choice(("init", "x"))),
}
TEXTS: dict[str, Bytes] = {
    "nested deeply": lambda data, dice: b'{"metrics": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "nested objects": lambda data, dice: b'{"a":' * 50_000 + b"1" + b"}" * 50_000,
    "NaN": lambda data, dice: data.replace(b'"seed": 0', b'"seed": NaN'),
    "1e999": lambda data, dice: data.replace(b'"seed": 0', b'"seed": 1e999'),
    "many digits": lambda data, dice: data.replace(b'"seed": 0', b'"seed": ' + b"9" * 10**4),
    "a list": lambda data, dice: b"[" + data + b"]",
    "a number": lambda data, dice: b"7",
    "not UTF-8": lambda data, dice: data.replace(b'"stage"', b'"\xff\xfe"'),
    "a key twice": lambda data, dice: data.replace(b'"seed": 0', b'"seed": 0, "seed": 1'),
    "large": lambda data, dice: data + b" " * 20_000_000,
    "spaces": lambda data, dice: b" " + data.replace(b": ", b" :\t") + b"\n",
}
"""Of JSON files, the whole text."""
HARMLESS = {"spaces"}

PLACES = (
    "another stage's", "other parameters'", "link outside", "link to itself", "link to a pipe",
    "a pipe", "link to a device", "a folder", "gone",
)  # fmt: skip


def _place(name: str, path: Path, dice: random.Random, other: Path, outside: Path) -> None:
    """Something else at the place of a file; ``other`` is a run of other parameters."""
    like = [p for p in path.parent.glob(f"*{path.suffix}") if p != path and p.is_file()]
    if name == "another stage's" and like:
        path.write_bytes(dice.choice(like).read_bytes())
        return
    if name == "other parameters'" and (other / path.name).exists():
        path.write_bytes((other / path.name).read_bytes())
        return
    former = path.read_bytes()
    path.unlink()
    if name == "link outside":
        shutil.rmtree(outside, ignore_errors=True)
        outside.write_bytes(former)
        path.symlink_to(outside)
    elif name == "link to itself":
        path.symlink_to(path.name)
    elif name == "link to a pipe":
        os.mkfifo(outside.with_name("pipe"))
        path.symlink_to(outside.with_name("pipe"))
    elif name == "a pipe":
        os.mkfifo(path)
    elif name == "link to a device":
        path.symlink_to("/dev/zero")
    elif name == "a folder":
        path.mkdir()


def of_file(path: Path) -> list[str]:
    """The names of the damages that a file can take."""
    if path.suffix == ".json":
        return [*BYTES, *PLACES, *TEXTS, *VALUES, *(f"{name}, sealed" for name in VALUES)]
    return [*BYTES, *PLACES]


def damage(
    name: str, path: Path, dice: random.Random, restore: bool, other: Path, outside: Path
) -> None:
    """Damage a file, and ``restore`` its modification time.

    A manifest is ``sealed`` again as by somebody who knows how: its checksums fit.
    """
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    if name in PLACES:
        _place(name, path, dice, other, outside)
    elif name in BYTES or name in TEXTS:
        path.write_bytes((BYTES | TEXTS)[name](path.read_bytes(), dice))
    else:
        record = json.loads(path.read_bytes())
        changed = copy.deepcopy(record)
        VALUES[name.removesuffix(", sealed")](changed, dice)
        path.write_bytes(sealed(changed) if name.endswith("sealed") else encoded(changed))
    if restore and path.exists() and not path.is_symlink():
        os.utime(path, ns=times)


def encoded(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=2, sort_keys=True) + "\n").encode()


def sealed(record: dict[str, Any]) -> bytes:
    """A manifest with checksums that fit, whatever else it holds."""
    from vorolight.stages.artifacts.manifest import _sealed

    try:
        return encoded(_sealed(record))
    except (KeyError, TypeError, AttributeError):
        return encoded(record)
