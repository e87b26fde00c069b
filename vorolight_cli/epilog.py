"""The end of ``vorolight --help``: exit codes and environment variables."""

from __future__ import annotations

from vorolight.stages.errors import VorolightError
from vorolight.stages.fabrication.slicer import VARIABLE

CODES = {
    "0": "Done, or up to date.",
    "1": "A fault of vorolight itself; run again with -v and report it.",
    **{
        str(kind.exit_code): str(kind.__doc__).split("\n\n")[0]
        for kind in VorolightError.__subclasses__()
    },
    "130": "Stopped by SIGINT; the same command resumes.",
    "143": "Stopped by SIGTERM; the same command resumes.",
}
VARIABLES = {
    "VOROLIGHT_RUN": "The run folder, where --run is not given.",
    VARIABLE: "The slicer's command.",
    "NO_COLOR": "If set, no colours.",
    "NUMBA_CACHE_DIR": "Where compiled loops are kept.",
}


def _rows(title: str, rows: dict[str, str]) -> str:
    width = max(map(len, rows))
    lines = [f"  {name:{width}s}  {meaning}" for name, meaning in rows.items()]
    return "\b\n" + "\n".join([title, *lines])


EPILOG = "\n\n".join(
    [
        "Example: vorolight run bunny.obj -n 25 --lamp",
        _rows("Exit codes:", CODES),
        _rows("Environment variables:", VARIABLES),
    ]
)
