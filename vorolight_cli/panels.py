"""The commands of ``vorolight --help`` in groups, each with a title, in the order of their use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from typer.core import TyperGroup

from vorolight.stages.engine.registry import ORDER

if TYPE_CHECKING:
    from collections.abc import Iterator

PANELS: dict[str, tuple[str, ...]] = {
    "First run": ("run", "sample", "status", "report"),
    "Stages, in their order": ORDER,
    "Tools": (
        "export", "compare", "collect", "sbatch", "baseline", "views", "from-image", "doctor",
    ),
}  # fmt: skip


class Panels(TyperGroup):
    """The group of all commands, which lists them by PANELS."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for names in PANELS.values() for name in names]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        width = max(map(len, self.list_commands(ctx)))
        for title, names in PANELS.items():
            with formatter.section(title):
                rows = self._rows(ctx, names, formatter.width - 6 - width)
                formatter.write_dl([(name.ljust(width), about) for name, about in rows])

    def _rows(self, ctx: Any, names: tuple[str, ...], limit: int) -> Iterator[tuple[str, str]]:
        for name in names:
            command = self.get_command(ctx, name)
            assert command is not None
            yield name, command.get_short_help_str(limit)
