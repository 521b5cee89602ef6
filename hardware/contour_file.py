"""Contours as CSV: a flat wound, x_mm,y_mm, or the outline of a wound on a scan, x_mm,y_mm,z_mm."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks

AXES = ("x_mm", "y_mm", "z_mm")


def read_contour(file: str | Path) -> Array:
    """Points (N, 2) or (N, 3), mm, in order around a contour, the first not repeated at the end; N >= 3."""
    file = Path(file)
    rows = [(n, [word.strip() for word in row]) for n, row in checks.read_csv(file) if any(map(str.strip, row))]
    allowed = "x_mm,y_mm or x_mm,y_mm,z_mm"
    if not rows:
        raise InputError(file, "file", "empty", f"a header {allowed} and 3 points or more")
    (_, header), body = rows[0], rows[1:]
    if tuple(header) not in (AXES[:2], AXES):
        raise InputError(file, "header", ",".join(header), allowed)
    points = np.array([_point(file, line, row, len(header)) for line, row in body]).reshape(-1, len(header))
    keep = np.ones(len(points), bool)
    keep[1:] = np.abs(np.diff(points, axis=0)).max(axis=1, initial=0.0) > 0
    points = points[keep]
    if len(points) > 1 and np.array_equal(points[0], points[-1]):
        points = points[:-1]
    if len(points) < 3:
        raise InputError(file, "points", len(points), "3 or more, each at another place")
    return points


def _point(file: Path, line: int, row: list[str], count: int) -> list[float]:
    if len(row) != count:
        raise InputError(file, f"line {line}", f"{len(row)} values", f"{count}, as in the header")
    try:
        point = [float(word) for word in row]
    except ValueError:
        raise InputError(file, f"line {line}", ",".join(row), "numbers, mm") from None
    if not all(map(math.isfinite, point)):
        raise InputError(file, f"line {line}", ",".join(row), "finite numbers, mm")
    return point
