"""Output for the user: progress on stderr, results on stdout."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Any, TextIO

BAR = 24


class Console:
    """Progress and messages in the form that the output can show: a bar on a terminal, lines
    elsewhere."""

    def __init__(self, verbosity: int, as_json: bool, color: bool) -> None:
        self.verbosity = verbosity
        self.as_json = as_json
        self.stream: TextIO = sys.stderr
        self.bar = self.stream.isatty() and verbosity > 0
        self.color = color and sys.stdout.isatty() and "NO_COLOR" not in os.environ
        self.label, self.total, self.shown, self.began = "", 0, -1, 0.0

    def start(self, label: str, total: int) -> None:
        self.finish()
        self.label, self.total, self.shown, self.began = label, total, -1, time.monotonic()

    def advance(self, done: int, note: str = "") -> None:
        share = 1.0 if self.total == 0 else min(done / self.total, 1.0)
        if self.bar:
            filled = round(share * BAR)
            text = f"\r{self.label:14s} [{'#' * filled}{'.' * (BAR - filled)}] {share:4.0%} {note}"
            self.stream.write(f"{text:79.79s}")
            self.stream.flush()
        elif self.verbosity > 0 and int(share * 10) > self.shown:
            self.shown = int(share * 10)
            elapsed = time.monotonic() - self.began
            print(f"{self.label}: {share:.0%} {elapsed:.1f} s {note}", file=self.stream, flush=True)

    def finish(self) -> None:
        if self.bar and self.label:
            self.stream.write("\r" + " " * 79 + "\r")
            self.stream.flush()
        self.label = ""

    def say(self, text: str) -> None:
        """A line of result on stdout, unless JSON was asked for or ``-q`` given."""
        if self.verbosity > 0 and not self.as_json:
            print(text, flush=True)

    def note(self, text: str) -> None:
        """A line on stderr, unless ``-q`` was given."""
        if self.verbosity > 0:
            print(plain(text), file=self.stream, flush=True)

    def detail(self, text: str) -> None:
        """A line on stderr with ``-v``."""
        if self.verbosity > 1:
            print(plain(text), file=self.stream, flush=True)

    def warn(self, text: str) -> None:
        print(f"warning: {plain(text)}", file=self.stream, flush=True)

    def data(self, value: Any) -> None:
        """One JSON value on stdout, with ``--json`` only."""
        if self.as_json:
            print(json.dumps(value, sort_keys=True), flush=True)

    def strong(self, text: str) -> str:
        return f"\033[1m{text}\033[0m" if self.color else text


def plain(text: str) -> str:
    """``text`` on one line, without control characters: names of files and manifests may contain
    anything."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def table(rows: Sequence[tuple[str, ...]]) -> str:
    """Columns padded to their widest entry."""
    rows = [tuple(plain(cell) for cell in row) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )
