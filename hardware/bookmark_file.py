"""How far a print is, as a file that outlives the run: progress.toml.

path = "3f0c..."      # fingerprint of the path's places, speeds, materials, temperatures, layers and extrusion
fraction = 12.35      # place on it, counted in checkpoints
printed = 12          # the last checkpoint that is done, for people
"""

from __future__ import annotations

import os
from math import floor
from pathlib import Path as File

from hardware.process import checks
from planning.path import Path
from planning.progress import Bookmark, Progress, bookmark, fingerprint, resumed

KEYS = ("path", "fraction", "printed")


class BookmarkFile:
    """Keeps the file up to date, tick by tick; whatever ends the run, the file there is whole."""

    def __init__(self, file: File, path: Path) -> None:
        self._file, self._path = file, fingerprint(path)
        self._fraction = -1.0

    def write(self, progress: Progress) -> None:
        """Write how far the print is, if it went on since the last time."""
        if progress.fraction != self._fraction:
            self._fraction = progress.fraction
            _replace(self._file, Bookmark(self._path, progress.fraction), progress.printed)


def keep_bookmark(file: File, fingerprint: str, fraction: float) -> None:
    """Write how far a print is, so that it outlives a power cut as well: this waits for the disk."""
    _replace(file, Bookmark(fingerprint, fraction), floor(fraction), sure=True)


def write_bookmark(file: File, path: Path, progress: Progress) -> None:
    """Write how far a print of `path` is."""
    _replace(file, bookmark(path, progress), progress.printed)


def read_start(file: File, path: Path) -> float:
    """Where a print of `path` goes on, counted in checkpoints; InputError if the file is of another path or wrong."""
    table = checks.read_toml(file)
    checks.check_keys(file, "", table, KEYS)
    mark = Bookmark(checks.text(file, "path", table["path"]), checks.number(file, "fraction", table["fraction"]))
    return resumed(path, mark, file)


def _replace(file: File, mark: Bookmark, printed: int, sure: bool = False) -> None:
    """Write beside the file and rename: there is always one that can be read. sure: it is on the disk on return."""
    text = f'path = "{mark.path}"\nfraction = {checks.toml_number(mark.fraction)}\nprinted = {printed}\n'
    beside = file.with_name(file.name + ".new")
    with beside.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        if sure:
            os.fsync(stream.fileno())
    beside.replace(file)
