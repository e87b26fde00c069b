"""Sample inputs that come with an installed package; nothing is downloaded."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from ..errors import BackendMissing, UsageError

SAMPLES = {
    "airplane": "airplane.obj",
    "bone": "bone.ply",
    "bunny": "bunny.obj",
    "chameleon": "chameleon.pts",
    "cow": "cow.obj",
    "cube": "cube.obj",
}
"""Name -> file in pymeshlab's folder of sample meshes."""


def sample(name: str) -> Path:
    """The installed file of a sample. pymeshlab is not imported, only its data files are used.

    Raises UsageError for unknown names, BackendMissing when pymeshlab is not installed.
    """
    if name not in SAMPLES:
        raise UsageError(f"{name}: no such sample; there are {', '.join(sorted(SAMPLES))}")
    package = importlib.util.find_spec("pymeshlab")
    places = list(package.submodule_search_locations or []) if package else []
    for place in places:
        path = Path(place) / "tests" / "sample_meshes" / SAMPLES[name]
        if path.is_file():
            return path
    raise BackendMissing("the samples come with pymeshlab, which is not installed; pip install it")
