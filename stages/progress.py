"""Where work reports how far it is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives the progress of a stage."""

    def start(self, label: str, total: int) -> None: ...

    def advance(self, done: int, note: str = "") -> None: ...

    def finish(self) -> None: ...

    def note(self, text: str) -> None: ...

    def detail(self, text: str) -> None: ...


class Silent:
    """Progress that is not shown."""

    def start(self, label: str, total: int) -> None:
        pass

    def advance(self, done: int, note: str = "") -> None:
        pass

    def finish(self) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def detail(self, text: str) -> None:
        pass
