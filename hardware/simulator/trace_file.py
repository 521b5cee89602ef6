"""Recorded motions from files: TUM, and CSV whose header names its columns and their units.

A CSV has a time (`t_s`, `stamp_s`, or `frame` beside a rate), a place (`tx_mm ty_mm tz_mm`, `x_mm ...`, or either
in `m`) and, if it turns, a rotation vector (`rx_deg ry_deg rz_deg` or `rx_rad ...`) or a quaternion (`qx qy qz qw`).
Further columns are left alone, unless they are one of these in a unit that is not known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from hardware.tum import read_rows

MM = {"mm": 1.0, "m": 1000.0}
PLACES = [(stem + "_" + unit, scale) for stem in ("t{}", "{}") for unit, scale in MM.items()]
TURNS = [("r{}_deg", math.pi / 180), ("r{}_rad", 1.0)]
QUATERNION = ["qx", "qy", "qz", "qw"]
TIMES = ["t_s", "stamp_s", "frame"]
KNOWN = [*TIMES, *(n.format(a) for n, _ in [*PLACES, *TURNS] for a in "xyz"), *QUATERNION]
STEMS = {name.rsplit("_", 1)[0]: name for name in reversed(KNOWN) if "_" in name}  # tx: tx_mm, for a tx_cm
LONGEST_GAP = 1.0  # s without a sample: a spline across more would be invention
LEAST, LEAST_STATED = 1.0, 0.05  # mm that a trace spans; less are metres taken for mm (stated: less than any noise)
MOST = 2000.0  # mm; more are mm taken for metres


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """A recorded motion. stamps: (N,) s, from 0. poses: (N, 4, 4) mm, relative to the first. where: its file."""

    where: Path
    stamps: Array
    poses: Array


def read_trace(path: Path, unit: str | None = None, rate_hz: float | None = None, start_s: float = 0.0) -> Trace:
    """The trace in a .csv or TUM file from `start_s` on, relative to its pose there.

    unit: of a TUM file, "mm" (as also where None) or "m". rate_hz: of a CSV that counts frames. InputError names what
    cannot be used: no file, not finite, stamps that go back, a gap, too short, or a unit that cannot be meant.
    """
    if not path.is_file():
        raise InputError(path, "file", "no such file", "a trace, TUM or .csv")
    if path.suffix.lower() == ".csv":
        if unit is not None:
            raise InputError(path, "unit", unit, "none: the columns of a CSV name their own (tx_mm, tx_m)")
        stamps, poses = _from_csv(path, rate_hz)
    else:
        if rate_hz is not None:
            raise InputError(path, "rate_hz", rate_hz, "none: only a CSV with a column `frame` needs it")
        rows = read_rows(path)
        stamps = rows[:, 0]
        poses = se3.make(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4] * MM[unit or "mm"])
    stated = unit is not None or path.suffix.lower() == ".csv"
    _check(path, stamps, poses[:, :3, 3], LEAST_STATED if stated else LEAST)
    return _from_start(path, stamps - stamps[0], poses, start_s)


def _from_start(path: Path, stamps: Array, poses: Array, start_s: float) -> Trace:
    first = int(np.searchsorted(stamps, start_s - 1e-9))
    if len(stamps) - first < 8:
        raise InputError(path, "start_s", start_s, f"8 poses or more after it; the trace lasts {stamps[-1]:g} s")
    return Trace(path, stamps[first:] - stamps[first], se3.inverse(poses[first]) @ poses[first:])


def _check(path: Path, stamps: Array, places: Array, least: float) -> None:
    steps = np.diff(stamps)
    if len(stamps) < 8:
        raise InputError(path, "poses", len(stamps), "8 or more")
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise InputError(path, f"stamp of pose {k + 2}", stamps[k + 1], f"later than the one before, {stamps[k]} s")
    if steps.max() > LONGEST_GAP:
        k = int(np.argmax(steps > LONGEST_GAP))
        raise InputError(
            path, f"gap after {stamps[k]:.10g} s", f"{steps[k]:g} s", f"at most {LONGEST_GAP:g} s (stamps in s)"
        )
    span = float(np.ptp(places, axis=0).max())
    if 0 < span < least:
        raise InputError(
            path, "places span", f"{span:g} mm", f'{least:g} mm or more; if they are metres: unit = "m", columns tx_m'
        )
    if span > MOST:
        raise InputError(path, "places span", f"{span:g} mm", f"at most {MOST:g} mm; are they mm, not metres?")


def _from_csv(path: Path, rate_hz: float | None) -> tuple[Array, Array]:
    columns = _columns(path)
    _check_units(path, columns)
    time = next((name for name in TIMES if name in columns), None)
    if time is None:
        raise InputError(path, "header", ",".join(columns)[:80], f"a column {', '.join(TIMES)}")
    if (time == "frame") != (rate_hz is not None):
        allowed = "the rate of the column `frame`" if time == "frame" else f"none: there is a column {time}"
        raise InputError(path, "rate_hz", "missing" if rate_hz is None else rate_hz, allowed)
    stamps = columns[time] / (rate_hz or 1.0)
    places = _triple(columns, PLACES)
    if places is None:
        raise InputError(path, "header", ",".join(columns)[:80], "columns tx_mm, ty_mm, tz_mm")
    return stamps, se3.make(_rotations(path, columns, len(stamps)), places)


def _check_units(path: Path, columns: dict[str, Array]) -> None:
    for name in columns:
        if name not in KNOWN and (stem := name.rsplit("_", 1)[0].lower()) in STEMS:
            raise InputError(
                path, "header", name, f"{STEMS[stem]}, or that column in another unit: {checks.meant(name, KNOWN)}"
            )


def _triple(columns: dict[str, Array], kinds: list[tuple[str, float]]) -> Array | None:
    for name, scale in kinds:
        if all(name.format(axis) in columns for axis in "xyz"):
            return np.stack([columns[name.format(axis)] for axis in "xyz"], axis=1) * scale
    return None


def _rotations(path: Path, columns: dict[str, Array], count: int) -> Array:
    turns = _triple(columns, TURNS)
    if turns is not None:
        return se3.exp_rotation(turns)
    if all(name in columns for name in QUATERNION):
        quaternions = np.stack([columns[name] for name in QUATERNION], axis=1)
        lengths = np.linalg.norm(quaternions, axis=1)
        if np.abs(lengths - 1).max() > 0.01:
            raise InputError(path, "length of qx qy qz qw", lengths[np.argmax(np.abs(lengths - 1))], "1 +- 0.01")
        return se3.rotation_from_quaternion(quaternions)
    halves = [name for name in columns if name in KNOWN and name[0] in "rq"]
    if halves:
        raise InputError(path, "header", ",".join(halves), "all three of rx_deg, ry_deg, rz_deg, all four of qx to qw")
    return np.broadcast_to(np.eye(3), (count, 3, 3))


def _columns(path: Path) -> dict[str, Array]:
    """The columns by name; those that this file knows are checked, the others may hold anything and are left out."""
    rows = [(n, row) for n, row in checks.read_csv(path) if any(row)]
    if not rows:
        raise InputError(path, "file", "empty", "a header and 8 rows or more")
    header = [name.strip() for name in rows[0][1]]
    for n, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(path, f"line {n}", f"{len(row)} values", f"{len(header)}, as in the header")
    numbers = {name: _column(path, rows[1:], i, name) for i, name in enumerate(header) if name in KNOWN}
    return {name: numbers.get(name, np.empty(0)) for name in header}


def _column(path: Path, rows: list[tuple[int, list[str]]], index: int, name: str) -> Array:
    values = []
    for n, row in rows:
        try:
            values.append(float(row[index]))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise InputError(path, f"line {n}: {name}", row[index], "a finite number")
    return np.array(values)
