"""From images to observations, and the step that turns a frame set into a pose (floor 1).

Where its files are: in a clone under data/, in an installation under share/stillbed.
"""

from __future__ import annotations

import sysconfig
from pathlib import Path

from estimation.errors import InputError

__all__ = ["CLONE_DATA", "INSTALLED_DATA", "named_path", "shipped_file"]

CLONE_DATA = Path(__file__).parents[1] / "data"
INSTALLED_DATA = Path(sysconfig.get_path("data")) / "share/stillbed"


def shipped_file(folder: str, name: str) -> Path:
    """A file by its folder (models, scenarios, ...) and name; InputError where the installation lacks it."""
    for place in (CLONE_DATA, INSTALLED_DATA):
        if (place / folder / name).is_file():
            return place / folder / name
    raise InputError(CLONE_DATA / folder / name, "shipped", "no such file", "an installation with its data")


def named_path(text: str) -> Path:
    """A path as it is written on a command line. data/..., where there is none, is the file that came with stillbed."""
    path = Path(text)
    if path.parts[:1] == ("data",) and len(path.parts) > 2 and not path.exists():
        for place in (CLONE_DATA, INSTALLED_DATA):
            if (shipped := place.joinpath(*path.parts[1:])).is_file():
                return shipped
    return path
