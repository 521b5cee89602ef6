"""The printing path: checkpoints on the surface, in order (thesis 5.2), and what makes a path printable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array

LEVER = 10.0  # mm per rad: what a turn counts as length, and so how long a turn on the spot takes
NEAREST = 1e-3  # mm: checkpoints nearer than this, turn included, are one place and have no direction between them
FARTHEST = 1000.0  # mm: beyond, the unit was mistaken (the arm reaches 650 mm)
FASTEST = 200.0  # mm/s: above, the unit was mistaken (bioprinting is 1 to 30 mm/s, the arm's own top speed 250)
COLDEST, HOTTEST = -50.0, 500.0  # degrees C: far below and above any bio-ink and any thermoplastic


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Checkpoints as parallel arrays; N >= 2.

    surface_from_nozzle: (N, 4, 4) mm. The nozzle frame has its origin at the tip and z from the tip back into the
    tool, so the material leaves along -z; equal to the surface frame's axes, the tool stands upright on the surface.
    speed: (N,) mm/s, of the way to each checkpoint. material: (N,) int or str. temperature: (N,) degrees C.
    layer: (N,) int. extrude: (N,) bool, on the way to each checkpoint. extra: further named columns, each (N,).
    """

    surface_from_nozzle: Array
    speed: Array
    material: NDArray[np.int64] | NDArray[np.str_]
    temperature: Array
    layer: NDArray[np.int64]
    extrude: NDArray[np.bool_]
    extra: Mapping[str, NDArray[np.str_]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.speed)

    @property
    def zone(self) -> Array:
        """Low and high corner (2, 3), mm, in the surface frame of the box around all checkpoints."""
        places = self.surface_from_nozzle[:, :3, 3]
        return np.stack([places.min(axis=0), places.max(axis=0)])


def check_path(path: Path, where: object = "path", lines: Sequence[int] | None = None) -> Path:
    """The path itself, if it can be printed; InputError names the first checkpoint that cannot.

    where, lines: file, and line of each checkpoint in it, for the message; without lines, checkpoints count from 0.
    Refused: fewer than two checkpoints, columns of unequal length, what is no rigid motion (NaN), places and
    temperatures out of range, speeds that are not positive, and two checkpoints in a row that are one and the same.
    """
    _check_lengths(path, where)

    def name(i: int) -> str:
        return f"checkpoint {i}" if lines is None else f"line {lines[i]}"

    if (i := _first(~_rigid(path.surface_from_nozzle))) is not None:
        transform = path.surface_from_nozzle[i].tolist()
        raise InputError(where, f"{name(i)}: surface_from_nozzle", transform, "a finite rigid motion, mm")
    if (i := _first(np.abs(path.surface_from_nozzle[:, :3, 3]).max(1) > FARTHEST)) is not None:
        place = path.surface_from_nozzle[i, :3, 3].tolist()
        raise InputError(where, f"{name(i)}: position", place, f"within {FARTHEST:g} mm of the surface's origin")
    speed, heat = path.speed, path.temperature
    if (i := _first(~((speed > 0) & (speed <= FASTEST)))) is not None:  # NaN fails every comparison
        raise InputError(where, f"{name(i)}: speed", float(speed[i]), f"0 < speed <= {FASTEST:g} mm/s")
    if (i := _first(~((heat >= COLDEST) & (heat <= HOTTEST)))) is not None:
        raise InputError(where, f"{name(i)}: temperature", float(heat[i]), f"{COLDEST:g} to {HOTTEST:g} degrees C")
    if (i := _first(lengths(path.surface_from_nozzle) < NEAREST)) is not None:
        place = path.surface_from_nozzle[i + 1, :3, 3].tolist()
        raise InputError(where, f"{name(i + 1)}: position", place, f"{NEAREST:g} mm or more from {name(i)}")
    return path


def lengths(surface_from_nozzle: Array) -> Array:
    """Lengths (N-1,), mm, of the ways between poses (N, 4, 4): the longer of the move and the turn times LEVER."""
    return lengths_of(*steps(surface_from_nozzle))


def steps(surface_from_nozzle: Array) -> tuple[Array, Array]:
    """Moves (N-1, 3), mm, and turns (N-1, 3), body vectors in rad, between poses (N, 4, 4)."""
    rotations = surface_from_nozzle[:, :3, :3]
    turns = se3.log_rotation(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])
    return np.diff(surface_from_nozzle[:, :3, 3], axis=0), turns


def lengths_of(moves: Array, turns: Array) -> Array:
    """`lengths` of ways by their moves (M, 3), mm, and turns (M, 3), rad."""
    return np.asarray(np.maximum(np.linalg.norm(moves, axis=1), LEVER * np.linalg.norm(turns, axis=1)))


def _check_lengths(path: Path, where: object) -> None:
    count = len(path.surface_from_nozzle)
    if count < 2:
        raise InputError(where, "checkpoints", count, "2 or more")
    columns = {f.name: getattr(path, f.name) for f in fields(path) if f.name != "extra"} | dict(path.extra)
    for name, column in columns.items():
        if len(column) != count:
            raise InputError(where, name, f"{len(column)} values", f"{count}, one for each checkpoint")


def _first(wrong: NDArray[np.bool_]) -> int | None:
    found = np.flatnonzero(wrong)
    return int(found[0]) if len(found) else None


def _rigid(transforms: Array) -> NDArray[np.bool_]:
    """(N,) whether each of (N, 4, 4) is one, as se3.is_transform says it of one."""
    r = transforms[:, :3, :3]
    with np.errstate(invalid="ignore"):  # what is not finite is no rigid motion, whatever else comes out
        off = np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max((1, 2))
        last = np.abs(transforms[:, 3] - [0, 0, 0, 1]).max(1)
        ok = np.isfinite(transforms).all((1, 2)) & (off < 1e-5) & (last < 1e-5) & (np.linalg.det(r) > 0)
    return np.asarray(ok)
