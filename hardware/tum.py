"""Trajectories as TUM files: one `stamp x y z qx qy qz qw` a line, s and mm, base_from_surface."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.process.checks import why

HEADER = "# stamp_s x y z qx qy qz qw (mm, base_from_surface)\n"
ALLOWED = "8 numbers: stamp x y z qx qy qz qw"


def read_tum(path: str | Path, exact: bool) -> Trajectory:
    """The trajectory in a TUM file (s, mm); InputError names the line that is wrong."""
    return trajectory_from_rows(read_rows(path), exact)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file, every number with the digits that give the same float64 back."""
    write_rows(path, rows_from_trajectory(trajectory))


def trajectory_from_rows(rows: Array, exact: bool) -> Trajectory:
    """Poses from rows (N, 8) of stamp x y z qx qy qz qw, s and mm."""
    return Trajectory(rows[:, 0], se3.make(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4]), exact)


def rows_from_trajectory(trajectory: Trajectory) -> Array:
    """Rows (N, 8) of stamp x y z qx qy qz qw, s and mm."""
    transforms = trajectory.base_from_surface
    quaternions = se3.quaternion_from_rotation(transforms[:, :3, :3])
    return np.concatenate([trajectory.stamps[:, None], transforms[:, :3, 3], quaternions], axis=1)


def write_rows(path: str | Path, rows: Array) -> None:
    """Write rows (N, 8) of stamp x y z qx qy qz qw as a TUM file, shortest digits that round-trip."""
    with open(path, "w", encoding="utf-8") as file:
        file.write(HEADER)
        file.writelines(" ".join(repr(float(v)) for v in row) + "\n" for row in rows)


def read_rows(path: str | Path) -> Array:
    """Rows (N, 8) of a TUM file, N >= 1: finite, stamps rising, quaternions of unit length to 1 %."""
    path = Path(path)
    lines = ((f"line {number}", line.replace(",", " ").split()) for number, line in _lines(path))
    rows = checked_rows(path, ((what, row_from_words(path, what, words)) for what, words in lines))
    if not len(rows):
        raise InputError(path, "poses", "none", "at least one line `stamp x y z qx qy qz qw`")
    return rows


def checked_rows(where: object, rows: Iterable[tuple[str, Sequence[float]]]) -> Array:
    """Rows (N, 8) of stamp x y z qx qy qz qw, N >= 0, each told with its name, such as its line.

    InputError (where, name) unless they are finite, stamps rise and quaternions are of unit length to 1 %.
    """
    checked: list[Sequence[float]] = []
    for what, row in rows:
        if len(row) != 8:
            raise InputError(where, what, f"{len(row)} numbers", ALLOWED)
        if not all(map(math.isfinite, row)):
            raise InputError(where, what, " ".join(map(str, row)), "finite numbers")
        norm = math.hypot(*row[4:])
        if not 0.99 < norm < 1.01:
            raise InputError(where, f"{what}: length of qx qy qz qw", norm, "1 +- 0.01 (a unit quaternion)")
        if checked and row[0] <= checked[-1][0]:
            raise InputError(where, f"{what}: stamp", row[0], f"later than the one before, {checked[-1][0]} s")
        checked.append(row)
    return np.array(checked, float).reshape(-1, 8)


def row_from_words(where: object, what: str, words: Sequence[str], allowed: str = ALLOWED) -> list[float]:
    """The numbers in words; InputError (where, what, with `allowed`) unless they are numbers."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise InputError(where, what, " ".join(words), allowed) from None


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "file", why(error), "a readable text file") from error
    numbered = ((i, line.strip()) for i, line in enumerate(text.splitlines(), 1))
    return [(i, line) for i, line in numbered if line and not line.startswith("#")]
