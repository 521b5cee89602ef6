"""commanded.csv: where the arm's controller was sent, as knots of straight ways, by the computer's clock.

    stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg

A line is written when nothing can change it any more, so what was done is kept whatever happens next.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np

from estimation.arm_calibration.set_point import SetPoint
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.queue import Stretch

NAME = "commanded.csv"
HEADER = "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
RESOLUTION = 2e-6  # s: knots nearer than what six digits tell apart are one
_UNITS = np.array([1, 1, 1, *np.rad2deg([1.0, 1, 1])])


class CommandedFile:
    """The file in the making."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        self._file.write(HEADER + "\n")
        self._last = -np.inf
        self._until = -np.inf

    def note(self, arm: Arm, now: float) -> None:
        """Write the ways that are over at `now`, s."""
        for way in arm.ways(self._until):
            if way.end <= now:
                self._add(way)
                self._until = way.end

    def _add(self, way: Stretch) -> None:
        for instant, axes in ((way.start, way.source), (way.end, way.target)):
            if instant >= self._last + RESOLUTION:
                self._file.write(f"{instant:.6f}," + ",".join(f"{v:.6f}" for v in np.array(axes) * _UNITS) + "\n")
                self._last = instant

    def __enter__(self) -> CommandedFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()


def read_commanded(path: Path) -> SetPoint:
    """The set-point in a commanded.csv; InputError where it is none."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        allowed = f"a text file that begins with {HEADER}"
        raise InputError(path, "file", "missing or not text", allowed) from None
    if not lines or lines[0].strip() != HEADER:
        raise InputError(path, "line 1", lines[0][:60] if lines else "nothing", HEADER)
    rows = [_row(path, number, line) for number, line in enumerate(lines[1:], 2) if line.strip()]
    if len(rows) < 2:
        raise InputError(path, "rows", len(rows), "two or more")
    table = np.array(rows)
    if (back := np.flatnonzero(np.diff(table[:, 0]) <= 0)).size:
        raise InputError(path, f"line {back[0] + 3}: stamp_s", table[back[0] + 1, 0], "stamps that rise")
    return SetPoint(np.ascontiguousarray(table[:, 0]), table[:, 1:] / _UNITS)


def _row(path: Path, number: int, line: str) -> Array:
    try:
        row = np.array([float(word) for word in line.split(",")])
    except ValueError:
        row = np.zeros(0)
    if row.shape != (7,) or not np.isfinite(row).all():
        raise InputError(path, f"line {number}", line[:60], "7 finite numbers: s, mm and degrees")
    return row
