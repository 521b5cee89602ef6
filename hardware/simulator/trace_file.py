"""Recorded motions from files, TUM or CSV, played as parts of a simulated one: there and back, or held at the end.

The header of a CSV names its columns and their units: a time (`t_s`, `stamp_s`, or `frame` beside a rate), a place
(`tx_mm ty_mm tz_mm`, `x_mm ...`, or either in `m`) and, if it turns, a rotation vector (`rx_deg ry_deg rz_deg` or
`rx_rad ...`) or a quaternion (`qx qy qz qw`). Other columns are ignored, unless they are one of these in an unknown
unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.folder_tables import read_rows
from hardware.process import checks

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0}
PLACE_COLUMNS = [(stem + "_" + unit, scale) for stem in ("t{}", "{}") for unit, scale in MM_PER_UNIT.items()]
TURN_COLUMNS = [("r{}_deg", math.pi / 180), ("r{}_rad", 1.0)]
QUATERNION_COLUMNS = ["qx", "qy", "qz", "qw"]
TIME_COLUMNS = ["t_s", "stamp_s", "frame"]
_AXIS_COLUMNS = [name.format(axis) for name, _ in [*PLACE_COLUMNS, *TURN_COLUMNS] for axis in "xyz"]
KNOWN_COLUMNS = [*TIME_COLUMNS, *_AXIS_COLUMNS, *QUATERNION_COLUMNS]
COLUMN_STEMS = {name.rsplit("_", 1)[0]: name for name in reversed(KNOWN_COLUMNS) if "_" in name}  # tx: tx_mm
MAX_TRACE_GAP = 1.0  # s without a sample: a spline across more would be invention
MIN_SPAN = 1.0  # mm that a trace spans; less are metres taken for mm
MIN_SPAN_STATED = 0.05  # mm, where the unit is stated: less than any noise
MAX_SPAN = 2000.0  # mm; more are mm taken for metres


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """A recorded motion."""

    where: Path  # its file
    stamps: Array  # (N,) s, from 0
    poses: Array  # (N, 4, 4) mm, relative to the first


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
        poses = se3.make(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4] * MM_PER_UNIT[unit or "mm"])
    stated = unit is not None or path.suffix.lower() == ".csv"
    _check(path, stamps, poses[:, :3, 3], MIN_SPAN_STATED if stated else MIN_SPAN)
    stamps = stamps - stamps[0]
    first = int(np.searchsorted(stamps, start_s - 1e-9))
    if len(stamps) - first < 8:
        raise InputError(path, "start_s", start_s, f"8 poses or more after it; the trace lasts {stamps[-1]:g} s")
    return Trace(path, stamps[first:] - stamps[first], se3.inverse(poses[first]) @ poses[first:])


def _check(path: Path, stamps: Array, places: Array, min_span: float) -> None:
    steps = np.diff(stamps)
    if len(stamps) < 8:
        raise InputError(path, "poses", len(stamps), "8 or more")
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise InputError(path, f"stamp of pose {k + 2}", stamps[k + 1], f"later than the one before, {stamps[k]} s")
    if steps.max() > MAX_TRACE_GAP:
        k = int(np.argmax(steps > MAX_TRACE_GAP))
        allowed = f"at most {MAX_TRACE_GAP:g} s (stamps in s)"
        raise InputError(path, f"gap after {stamps[k]:.10g} s", f"{steps[k]:g} s", allowed)
    span = float(np.ptp(places, axis=0).max())
    if 0 < span < min_span:
        allowed = f'{min_span:g} mm or more; if they are metres: unit = "m", columns tx_m'
        raise InputError(path, "places span", f"{span:g} mm", allowed)
    if span > MAX_SPAN:
        raise InputError(path, "places span", f"{span:g} mm", f"at most {MAX_SPAN:g} mm; are they mm, not metres?")


def _from_csv(path: Path, rate_hz: float | None) -> tuple[Array, Array]:
    columns = _columns(path)
    for name in columns:
        if name not in KNOWN_COLUMNS and (stem := name.rsplit("_", 1)[0].lower()) in COLUMN_STEMS:
            others = checks.one_of_text(name, KNOWN_COLUMNS)
            raise InputError(path, "header", name, f"{COLUMN_STEMS[stem]}, or that column in another unit: {others}")
    time = next((name for name in TIME_COLUMNS if name in columns), None)
    if time is None:
        raise InputError(path, "header", ",".join(columns)[:80], f"a column {', '.join(TIME_COLUMNS)}")
    if (time == "frame") != (rate_hz is not None):
        allowed = "the rate of the column `frame`" if time == "frame" else f"none: there is a column {time}"
        raise InputError(path, "rate_hz", "missing" if rate_hz is None else rate_hz, allowed)
    stamps = columns[time] / (rate_hz or 1.0)
    places = _triple(columns, PLACE_COLUMNS)
    if places is None:
        raise InputError(path, "header", ",".join(columns)[:80], "columns tx_mm, ty_mm, tz_mm")
    return stamps, se3.make(_rotations(path, columns, len(stamps)), places)


def _triple(columns: dict[str, Array], kinds: list[tuple[str, float]]) -> Array | None:
    for name, scale in kinds:
        if all(name.format(axis) in columns for axis in "xyz"):
            return np.stack([columns[name.format(axis)] for axis in "xyz"], axis=1) * scale
    return None


def _rotations(path: Path, columns: dict[str, Array], count: int) -> Array:
    turns = _triple(columns, TURN_COLUMNS)
    if turns is not None:
        return se3.exp_rotation(turns)
    if all(name in columns for name in QUATERNION_COLUMNS):
        quaternions = np.stack([columns[name] for name in QUATERNION_COLUMNS], axis=1)
        lengths = np.linalg.norm(quaternions, axis=1)
        if np.abs(lengths - 1).max() > 0.01:
            raise InputError(path, "length of qx qy qz qw", lengths[np.argmax(np.abs(lengths - 1))], "1 +- 0.01")
        return se3.rotation_from_quaternion(quaternions)
    if incomplete := [name for name in columns if name in KNOWN_COLUMNS and name[0] in "rq"]:
        allowed = "all three of rx_deg, ry_deg, rz_deg, all four of qx to qw"
        raise InputError(path, "header", ",".join(incomplete), allowed)
    return np.broadcast_to(np.eye(3), (count, 3, 3))


def _columns(path: Path) -> dict[str, Array]:
    """The columns by name; those that this file knows are checked, the others may hold anything and are left out."""
    lines, words = checks.csv_columns(path, checks.read_csv(path), "a header and 8 rows or more")
    known = {name: checks.csv_numbers(path, lines, name, words[name]) for name in words if name in KNOWN_COLUMNS}
    return {name: known.get(name, np.empty(0)) for name in words}


SMOOTH_STEPS = 5  # of the trace's own: periods below are taken away, on the 10 Hz chests 0.03-0.1 mm, their noise
MAX_TURN = math.radians(150)  # from the first pose: rotation vectors are interpolated, which end at 180
STOP_DURATION = 0.5  # s in which the play turns round or comes to its end


@dataclass(frozen=True, slots=True, eq=False)
class PlayedTrace:
    """A trace as a part of a motion."""

    spline: CubicSpline  # s -> (N, 6) rotation vector and shift, rad and mm
    duration: float  # s
    back: bool  # played there and back for ever; else it stops at the end
    pivot: Array  # (3,) mm

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm."""
        return np.asarray(self.spline(self._place_and_speed(times)[0]))

    def rates(self, times: Array) -> Array:
        """Their derivatives (N, 6)."""
        place, speed = self._place_and_speed(times)
        return np.asarray(self.spline(place, 1) * speed[:, None])

    def _place_and_speed(self, times: Array) -> tuple[Array, Array]:
        """Where in the trace, s: at 0 s at its beginning and at its own speed, before that slowly out of rest."""
        start, end = times + STOP_DURATION / 2, times - self.duration + STOP_DURATION / 2
        place = corner(start, STOP_DURATION) - STOP_DURATION / 2 - corner(end, STOP_DURATION)
        speed = corner_rate(start, STOP_DURATION) - corner_rate(end, STOP_DURATION)
        folds = self.back & (times > self.duration / 2)
        place = np.where(folds, folded(times, self.duration, STOP_DURATION), place)
        return place, np.where(folds, folded_rate(times, self.duration, STOP_DURATION), speed)


def played_trace(
    trace: Trace, scale: float, rotation: bool, smooth: float | None, back: bool, pivot: Array
) -> PlayedTrace:
    """A trace as a part: its shifts and rotations times `scale`, without the rotations where `rotation` is false.

    smooth: s, the period at which the low-pass keeps half (Butterworth of second order, forward and back, so without
    delay): of 0.1 mm noise at 10 Hz an interpolating spline would make speeds of mm/s that no chest had. None takes
    SMOOTH_STEPS of the trace's own steps, 0 nothing.
    """
    from scipy.interpolate import CubicSpline  # half a second, which runs without a trace need not spend

    stamps, duration = trace.stamps, float(trace.stamps[-1])
    step, zero = float(np.median(np.diff(stamps))), np.zeros((len(stamps), 3))
    smooth = SMOOTH_STEPS * step if smooth is None else smooth
    coordinates = np.concatenate([_rotation_vectors(trace) if rotation else zero, trace.poses[:, :3, 3]], axis=1)
    if duration < 2 * STOP_DURATION:
        raise InputError(trace.where, "duration", f"{duration:g} s", f"{2 * STOP_DURATION:g} s or more")
    if smooth > 0:
        if smooth < 2.5 * step:
            allowed = f"0, or at least 2.5 steps of the trace, {2.5 * step:g} s"
            raise InputError(trace.where, "smooth_s", smooth, allowed)
        stamps, coordinates = _smoothed(stamps, coordinates, step, smooth)
    coordinates = coordinates - coordinates[0]  # the filter moves the first sample too
    return PlayedTrace(CubicSpline(stamps, scale * coordinates), duration, back, pivot)


def _rotation_vectors(trace: Trace) -> Array:
    vectors = se3.log_rotation(trace.poses[:, :3, :3])
    widest = float(np.linalg.norm(vectors, axis=1).max())
    if widest > MAX_TURN:
        got = f"{math.degrees(widest):.0f} degrees from the pose at its start"
        raise InputError(trace.where, "rotation", got, f"at most {math.degrees(MAX_TURN):.0f}; or rotation = false")
    return vectors


def _smoothed(stamps: Array, coordinates: Array, step: float, smooth: float) -> tuple[Array, Array]:
    """Resampled to even steps and low-passed: stamps (M,) and coordinates (M, 6)."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import butter, filtfilt  # a second and a half, as above

    count = max(8, round(stamps[-1] / step) + 1)
    even = np.linspace(0.0, stamps[-1], count)
    values = CubicSpline(stamps, coordinates)(even)
    # of two passes each keeps 1 / sqrt(2) of the amplitude at its corner frequency
    b, a = butter(2, 1 / smooth, fs=(count - 1) / stamps[-1])
    return even, np.asarray(filtfilt(b, a, values, axis=0, padlen=min(count - 1, 3 * round(smooth / step) + 6)))


def corner(x: Array, rounding: float) -> Array:
    """max(x, 0) with its corner rounded over `rounding` about 0: exact outside, second derivative continuous."""
    u = np.clip(x / rounding + 0.5, 0.0, 1.0)
    return np.asarray(rounding * u**3 * (1 - u / 2) + np.maximum(x - rounding / 2, 0.0))


def corner_rate(x: Array, rounding: float) -> Array:
    """Derivative of `corner`: 0 to 1 along the cubic smoothstep."""
    u = np.clip(x / rounding + 0.5, 0.0, 1.0)
    return np.asarray(u * u * (3 - 2 * u))


def folded(x: Array, length: float, rounding: float) -> Array:
    """Distance (N,) from x to the nearest even multiple of `length`, 0 to `length`, with rounded corners."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    high = y - length
    return np.where(y < length / 2, 2 * corner(y, rounding) - y, length - (2 * corner(high, rounding) - high))


def folded_rate(x: Array, length: float, rounding: float) -> Array:
    """Derivative of `folded`."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    return np.where(y < length / 2, 2 * corner_rate(y, rounding) - 1, 1 - 2 * corner_rate(y - length, rounding))
