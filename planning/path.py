"""The printing path, checked that it can be printed, how far a print of it is, and where a later one goes on.

Checkpoints lie on the surface in printing order (thesis 5.2).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from math import floor

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array

LEVER_ARM = 10.0  # mm per rad: the length that a turn counts as, and so the time that a turn on the spot takes
MIN_SPACING = 1e-3  # mm: checkpoints that are nearer, turn included, have no direction between them
MAX_COORDINATE = 1000.0  # mm: beyond, the unit is wrong (the arm reaches 650 mm)
MAX_SPEED = 200.0  # mm/s: above, the unit is wrong (bioprinting is 1 to 30 mm/s, the arm's top speed 250)
MIN_TEMPERATURE, MAX_TEMPERATURE = -50.0, 500.0  # degrees C: far below and above any bio-ink or thermoplastic


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """N >= 2 checkpoints as parallel arrays.

    The nozzle frame has its origin at the tip and z from the tip back into the tool: material leaves along -z. Where
    its axes are those of the surface frame, the tool stands upright on the surface.
    """

    surface_from_nozzle: Array  # (N, 4, 4) mm
    speed: Array  # (N,) mm/s, on the way to each checkpoint
    material: NDArray[np.int64] | NDArray[np.str_]  # (N,)
    temperature: Array  # (N,) degrees C
    layer: NDArray[np.int64]  # (N,)
    extrude: NDArray[np.bool_]  # (N,) whether it extrudes on the way to each checkpoint
    extra: Mapping[str, NDArray[np.str_]] = field(default_factory=dict)  # further named columns (N,)

    def __len__(self) -> int:
        return len(self.speed)

    @property
    def zone(self) -> Array:
        """Low and high corner (2, 3) of the box around all checkpoints, surface frame, mm."""
        places = self.surface_from_nozzle[:, :3, 3]
        return np.stack([places.min(axis=0), places.max(axis=0)])


def check_path(
    path: Path,
    where: object = "path",
    lines: Sequence[int] | None = None,
    columns: Mapping[str, tuple[str, Sequence[str]]] | None = None,
) -> Path:
    """The path itself if it can be printed; else InputError names the first checkpoint that cannot.

    where, lines: the file, and each checkpoint's line in it, for the message; without lines, checkpoints count from 0.
    columns: of `speed` and `temperature` the file's column and each checkpoint's text there, for the message as well.
    Refused are fewer than two checkpoints, columns of unequal length, transforms that are no rigid motion, places,
    speeds and temperatures out of range, and two successive checkpoints at one place.
    """
    count = len(path.surface_from_nozzle)
    if count < 2:
        raise InputError(where, "checkpoints", count, "2 or more")
    own = {f.name: getattr(path, f.name) for f in fields(path) if f.name != "extra"}
    for column, values in (own | dict(path.extra)).items():
        if len(values) != count:
            raise InputError(where, column, f"{len(values)} values", f"{count}, one for each checkpoint")

    def name(i: int) -> str:
        return f"checkpoint {i}" if lines is None else f"line {lines[i]}"

    def wrong(i: int, value: str, got: object, allowed: str) -> InputError:
        header, texts = (columns or {}).get(value, (value, None))
        return InputError(where, f"{name(i)}: {header}", got if texts is None else texts[i], allowed)

    if (i := _first(~_rigid(path.surface_from_nozzle))) is not None:
        transform = path.surface_from_nozzle[i].tolist()
        raise InputError(where, f"{name(i)}: surface_from_nozzle", transform, "a finite rigid motion, mm")
    if (i := _first(np.abs(path.surface_from_nozzle[:, :3, 3]).max(1) > MAX_COORDINATE)) is not None:
        place = path.surface_from_nozzle[i, :3, 3].tolist()
        raise InputError(where, f"{name(i)}: position", place, f"within {MAX_COORDINATE:g} mm of the surface's origin")
    speed, heat = path.speed, path.temperature
    if (i := _first(~((speed > 0) & (speed <= MAX_SPEED)))) is not None:  # NaN fails every comparison
        raise wrong(i, "speed", float(speed[i]), f"0 < speed <= {MAX_SPEED:g} mm/s")
    if (i := _first(~((heat >= MIN_TEMPERATURE) & (heat <= MAX_TEMPERATURE)))) is not None:
        raise wrong(i, "temperature", float(heat[i]), f"{MIN_TEMPERATURE:g} to {MAX_TEMPERATURE:g} degrees C")
    if (i := _first(way_lengths(path.surface_from_nozzle) < MIN_SPACING)) is not None:
        place = path.surface_from_nozzle[i + 1, :3, 3].tolist()
        raise InputError(where, f"{name(i + 1)}: position", place, f"{MIN_SPACING:g} mm or more from {name(i)}")
    return path


def way_lengths(surface_from_nozzle: Array) -> Array:
    """Lengths (N-1,), mm, between poses (N, 4, 4): the longer of the move and of the turn times LEVER_ARM."""
    return lengths_from(*moves_and_turns(surface_from_nozzle))


def moves_and_turns(surface_from_nozzle: Array) -> tuple[Array, Array]:
    """Moves (N-1, 3), mm, and turns (N-1, 3), body vectors in rad, between poses (N, 4, 4)."""
    rotations = surface_from_nozzle[:, :3, :3]
    turns = se3.log_rotation(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])
    return np.diff(surface_from_nozzle[:, :3, 3], axis=0), turns


def lengths_from(moves: Array, turns: Array) -> Array:
    """`way_lengths` of ways by their moves (M, 3), mm, and turns (M, 3), rad."""
    return np.asarray(np.maximum(np.linalg.norm(moves, axis=1), LEVER_ARM * np.linalg.norm(turns, axis=1)))


def _first(wrong: NDArray[np.bool_]) -> int | None:
    indices = np.flatnonzero(wrong)
    return int(indices[0]) if len(indices) else None


def _rigid(transforms: Array) -> NDArray[np.bool_]:
    """Which (N,) of transforms (N, 4, 4) are rigid motions, by the test of se3.is_transform."""
    r = transforms[:, :3, :3]
    with np.errstate(invalid="ignore"):  # where a number is not finite, isfinite decides
        off = np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max((1, 2))
        last = np.abs(transforms[:, 3] - [0, 0, 0, 1]).max(1)
        rigid = np.isfinite(transforms).all((1, 2)) & (off < 1e-5) & (last < 1e-5) & (np.linalg.det(r) > 0)
    return np.asarray(rigid)


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
