"""The folder of what can be made again: pictures of scenarios, rendered before a live run shows them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from estimation.errors import InputError
from hardware.process.checks import why

REMEDY = "set XDG_CACHE_HOME to a folder that can be written"


def cache_folder() -> Path:
    """Where it is, as the XDG rules have it; it may not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stillbed"


def cache_trouble(folder: Path) -> str:
    """Why nothing can be written to a folder that is there or is still to be made; "" if it can. Leaves nothing."""
    there = next(place for place in (folder, *folder.absolute().parents) if os.path.lexists(place))
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        return why(error)
    return ""


def not_written(folder: Path, error: OSError) -> InputError:
    """What is told of a cache that could not be written."""
    return InputError(folder, "cache", why(error), "one that can be written: set XDG_CACHE_HOME")
