"""The stages there are, by name."""

from __future__ import annotations

import importlib

from ..errors import UsageError
from .stage import Stage

ORDER = ("classify", "init", "sphere-train", "volume", "shade", "evaluate", "fabricate")
"""The stages of a whole run, in order."""
ENDS = ("volume", "shade", "evaluate", "fabricate")
"""Stages of a whole run that can fail while those go on that do not need them."""
ALL = (*ORDER, "baseline")
"""Every stage, including those that only run on request."""


def get(name: str) -> Stage:
    """The stage called ``name``. Its module is imported now, not earlier."""
    module = importlib.import_module(f"vorolight.stages.{name.replace('-', '_')}")
    stage: Stage = module.STAGE
    return stage


def stages_until(until: str, kind: str) -> list[str]:
    """The stages of a run of an input of this ``kind``, in order, the last one being ``until``.

    Raises UsageError if it is not a stage of a whole run.
    """
    if until not in ORDER:
        raise UsageError(f"--until {until}: must be one of {', '.join(ORDER)}")
    stages = ORDER[: ORDER.index(until) + 1]
    return [name for name in stages if name != "shade" or kind == "views"]
