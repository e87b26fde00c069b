"""The end of ``vorolight --help``: exit codes and environment variables."""

from __future__ import annotations

from vorolight.stages.errors import VorolightError
from vorolight.stages.fabrication.slicer import VARIABLE

CODES = {
    "0": "Finished, or everything was up to date.",
    "1": "A fault in vorolight; run again with -v and report the traceback.",
    **{
        str(kind.exit_code): str(kind.__doc__).split("\n\n")[0]
        for kind in VorolightError.__subclasses__()
    },
    "130": "Stopped by SIGINT; the same command continues.",
    "143": "Stopped by SIGTERM; the same command continues.",
}
VARIABLES = {
    "VOROLIGHT_RUN": "The run folder if --run is not given.",
    VARIABLE: "The command of the slicer.",
    "NO_COLOR": "Print without colours if set.",
    "NUMBA_CACHE_DIR": "The folder for compiled loops.",
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
