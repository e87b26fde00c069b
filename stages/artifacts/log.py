"""The log of a stage, JSON lines in ``logs/<stem>.jsonl``, and its progress on the terminal."""

from __future__ import annotations

import json
import os
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..progress import Progress

FOLDER = "logs"
LARGEST = 4_000_000
"""Size in bytes above which a log is renamed to ``.1`` when the stage starts again."""
EVERY = 10.0
"""Number of seconds after which progress is logged even if it grew by less than a tenth."""


class StageLog:
    """Progress that is shown and logged. It owns the log file while its stage runs.

    If the log cannot be written, this is reported once, and the stage continues.
    """

    def __init__(self, folder: Path, stem: str, shown: Progress) -> None:
        self.shown = shown
        self.path = folder / FOLDER / f"{stem}.jsonl"
        self.label, self.total, self.tenth, self.logged = "", 0, -1, 0.0
        self.file: int | None = None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists() and self.path.stat().st_size > LARGEST:
                os.replace(self.path, self.path.with_suffix(".jsonl.1"))
            torn = self.path.exists() and self.path.read_bytes()[-1:] not in (b"", b"\n")
            self.file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            if torn:  # the last writer was killed within a line
                os.write(self.file, b"\n")
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.shown.note(f"{self.path}: no log is written ({error.strerror})")
        self.close()

    def close(self) -> None:
        """Close the file; later events are only shown."""
        if self.file is not None:
            os.close(self.file)
        self.file = None

    def event(self, name: str, **facts: Any) -> None:
        """Log one event; with ``-v`` it is shown too."""
        self._write(name, facts)
        shown = (f"{key}={value}" for key, value in facts.items() if key != "traceback")
        self.shown.detail(" ".join([name, *shown]))

    def _write(self, name: str, facts: dict[str, Any]) -> None:
        if self.file is None:
            return
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "pid": os.getpid(), "event": name, **facts}, default=str)
        try:
            os.write(self.file, line.encode() + b"\n")
        except OSError as error:
            self._give_up(error)

    def start(self, label: str, total: int) -> None:
        self.label, self.total, self.tenth = label, total, -1
        self.logged = time.monotonic()
        self.shown.start(label, total)

    def advance(self, done: int, note: str = "") -> None:
        self.shown.advance(done, note)
        tenth = 10 * done // max(self.total, 1)
        if tenth > self.tenth or time.monotonic() - self.logged > EVERY:
            self.tenth, self.logged = tenth, time.monotonic()
            facts = {"label": self.label, "done": done, "of": self.total, "note": note}
            self._write("progress", facts)

    def finish(self) -> None:
        self.shown.finish()

    def note(self, text: str) -> None:
        self._write("note", {"text": text})
        self.shown.note(text)

    def detail(self, text: str) -> None:
        self.event(text)


def read(folder: Path, stem: str) -> list[dict[str, Any]]:
    """The events of a stage's log, oldest first, without the incomplete
    line of a killed process."""
    events = []
    path = folder / FOLDER / f"{stem}.jsonl"
    if path.is_file():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                events.append(dict(json.loads(line)))
            except (ValueError, TypeError, RecursionError):
                continue
    return events
