"""The progress of a print, and the record by which a later run goes on where it stopped (thesis 5.2)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import Enum
from math import floor

import numpy as np

from estimation.errors import InputError
from planning.path import Path


class PrintPhase(Enum):
    """What the nozzle is doing."""

    WAITING = "waiting"  # at rest, nothing begun
    ENTERING = "entering"  # on the way to where printing begins or goes on
    PRINTING = "printing"
    RETREATING = "retreating"  # up from the surface in a pause, and then at rest above it
    LEAVING = "leaving"  # on the way up from the last checkpoint
    FINISHED = "finished"


@dataclass(frozen=True, slots=True)
class PrintProgress:
    """How far the print is."""

    phase: PrintPhase
    checkpoint: int  # the one being printed
    total: int  # checkpoints
    place: float  # mm of the path
    length: float  # mm of the whole path
    fraction: float  # the place in checkpoints: 2.35 is 35 % of the way from checkpoint 2 to 3
    wanted: str = ""  # material that an operator has to put in before it goes on, "" if none

    @property
    def printed(self) -> int:
        """The last checkpoint that is done."""
        return floor(self.fraction)

    @property
    def next(self) -> int | None:
        """The checkpoint after the one being printed; None where there is none."""
        return self.checkpoint + 1 if self.checkpoint + 1 < self.total else None


@dataclass(frozen=True, slots=True)
class ProgressMark:
    """Where a print stopped."""

    path: str  # fingerprint of its path
    fraction: float  # place in checkpoints


def progress_mark(path: Path, progress: PrintProgress) -> ProgressMark:
    """The record of a print of `path` that is as far as `progress` says."""
    return ProgressMark(fingerprint(path), progress.fraction)


def resume_fraction(path: Path, mark: ProgressMark, where: object = "bookmark") -> float:
    """The fraction at which a print of `path` goes on; InputError if the record is of another path or lies outside."""
    if mark.path != (own := fingerprint(path)):
        raise InputError(where, "path", mark.path, f"{own}, the fingerprint of the path to be printed")
    return check_start(path, mark.fraction, where)


def check_start(path: Path, fraction: float, where: object = "planner") -> float:
    """The fraction itself if it is a place on the path, counted in checkpoints; else InputError."""
    if not 0 <= fraction <= len(path) - 1:
        raise InputError(where, "fraction", fraction, f"0 to {len(path) - 1} checkpoints")
    return fraction


def fingerprint(path: Path) -> str:
    """A short name of all that is printed: places, speeds, materials, temperatures, layers, extrusion."""
    digest = hashlib.sha256()
    for column in (path.surface_from_nozzle, path.speed, path.temperature, path.layer, path.extrude):
        digest.update(np.ascontiguousarray(column).tobytes())
    digest.update("\n".join(map(str, path.material.tolist())).encode())
    return digest.hexdigest()[:16]
