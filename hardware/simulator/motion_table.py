"""Motions and waveforms from a scenario's tables: one `[[motion]]` a part, composed in the order of the file.

Every part has a `kind` and may have `pivot_mm` (the fixed point of its rotation):

    breathing  period_s or rate_hz, inspiration, exponent, period_spread, depth_spread, sighs_per_min, sigh_factor,
               pauses_per_min, pause_s                                        } of these four:
    pulse      rate_hz, rate_spread, depth_spread                             } amplitude_mm along direction [x, y, z]
    sine       rate_hz, phase_deg; mm_per_frame and fps for amplitude_mm      } (out of the surface), turn_deg [x, y, z]
    steps      every_s, rise_s, start_s, pattern "turns" or "stairs"; its amplitude is height_mm }
    tremor     rms_mm [x, y, z], rms_deg [x, y, z], band_hz
    hand       the same, slower, with 0 at 0 s
    drift      speed_mm_s, speed_deg_s [x, y, z]; walk_mm, walk_deg: RMS of a random walk after a minute
    ramp       speed_mm_s, speed_deg_s, start_s, end_s (none: for ever), back, round_s
    constant   the thesis's cube: unit_mm, speed_units_s, turn_deg_s, direction, axis, travel_s, round_s
    turn       angles_deg, axis, duration_s, hold_s, start_s, repeat
    trace      file, unit, rate_hz, start_s, scale, rotation, smooth_s, loop "back" or "hold"
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from estimation.synthetic import movements
from estimation.synthetic.movements import (
    BreathingSpec,
    ComposedMotion,
    MotionPart,
    Sine,
    StepWave,
    Waveform,
    WaveformMotion,
    ease,
    ease_rate,
)
from hardware.process import checks
from hardware.process.checks import Table
from hardware.simulator.scenario_tables import TableReader
from hardware.simulator.trace_file import corner, corner_rate, folded, folded_rate, played_trace, read_trace

MOTION_STREAM = 21  # of the scenario's seed, for motions alone
ZERO, SURFACE_NORMAL = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
THESIS_UNIT_MM = 100.0  # edge of the thesis's cube: 282 px at 400 mm before 1109 px of focal length are 102 mm
MAX_SPREAD = 0.9 / movements.MAX_DRAW_SIGMAS  # no breath and no beat may have length 0

Generator = np.random.Generator


def motion_from_tables(where: object, tables: list[Table], folder: Path, seed: int) -> ComposedMotion:
    """The motion that `[[motion]]` tables describe, none for a surface at rest.

    folder: of relative trace files. seed: >= 0; part i draws from it and i alone. InputError names the key.
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError(where, "motion", tables, "[[motion]] tables")
    return ComposedMotion(tuple(_part(where, i, table, folder, seed) for i, table in enumerate(tables)))


def waveform_from_table(where: object, key: str, table: Table, rng: Generator) -> Waveform:
    """A waveform alone, of height 1: a table `key` of kind breathing, pulse, sine or steps, without amplitude."""
    if not isinstance(table, dict):
        raise InputError(where, key, table, f"a table [{key}]")
    keys = TableReader(where, f"{key}.", table)
    wave = WAVE_KINDS[keys.word("kind", list(WAVE_KINDS))](keys, rng)
    keys.done()
    return wave


def _part(where: object, number: int, table: Table, folder: Path, seed: int) -> MotionPart:
    keys = TableReader(where, f"motion[{number}].", table)
    kind = keys.word("kind", [*WAVE_KINDS, *PART_KINDS])
    rng = np.random.default_rng([seed, MOTION_STREAM, number])
    pivot = keys.vector("pivot_mm", ZERO)
    part = _waveform_part(keys, kind, rng, pivot) if kind in WAVE_KINDS else PART_KINDS[kind](keys, rng, pivot, folder)
    keys.done()
    return part


def _waveform_part(keys: TableReader, kind: str, rng: Generator, pivot: Array) -> WaveformMotion:
    wave = WAVE_KINDS[kind](keys, rng)
    direction, turn = keys.axis("direction", SURFACE_NORMAL), np.deg2rad(keys.vector("turn_deg", ZERO))
    name = "height_mm" if kind == "steps" else "amplitude_mm"
    if kind == "sine" and keys.has("mm_per_frame"):
        if keys.has(name):
            raise InputError(keys.where, keys.prefix + name, keys.table[name], "none beside mm_per_frame")
        fps = keys.number("fps", movements.FRAMES_PER_S, 0, open=True)
        amplitude = movements.shaking_amplitude(keys.number("mm_per_frame"), keys.number("rate_hz"), fps)
    else:
        amplitude = keys.number(name, 0.0 if turn.any() else None)
    return WaveformMotion((wave,), np.concatenate([turn, amplitude * direction])[None], pivot)


def _breathing(keys: TableReader, rng: Generator) -> Waveform:
    defaults = BreathingSpec()
    if keys.has("rate_hz") and keys.has("period_s"):
        raise InputError(keys.where, keys.prefix + "rate_hz", keys.table["rate_hz"], "one of rate_hz, period_s")
    rate = keys.number("rate_hz", 1 / defaults.period, 0.02, 5)
    spec = BreathingSpec(
        period=keys.number("period_s", 1 / rate, 0.2, 50),
        inspiration=keys.number("inspiration", defaults.inspiration, 0.1, 0.9),
        exponent=keys.number("exponent", defaults.exponent, 2, 20),
        period_spread=keys.number("period_spread", defaults.period_spread, 0, MAX_SPREAD),
        depth_spread=keys.number("depth_spread", defaults.depth_spread, 0, MAX_SPREAD),
        sighs_per_min=keys.number("sighs_per_min", defaults.sighs_per_min, 0, 10),
        sigh_factor=keys.number("sigh_factor", defaults.sigh_factor, 1, 5),
        pauses_per_min=keys.number("pauses_per_min", defaults.pauses_per_min, 0, 10),
        pause=keys.number("pause_s", defaults.pause, 0, 60),
    )
    return movements.draw_breathing(spec, rng)


def _pulse(keys: TableReader, rng: Generator) -> Waveform:
    rate = keys.number("rate_hz", 1.15, 0.2, 5)
    rate_spread, depth_spread = (keys.number(n, 0.05, 0, MAX_SPREAD) for n in ("rate_spread", "depth_spread"))
    return movements.draw_pulse(rate, rate_spread, depth_spread, rng)


def _sine(keys: TableReader, rng: Generator) -> Waveform:
    return Sine(keys.number("rate_hz", None, 0, 50, open=True), math.radians(keys.number("phase_deg", 0.0)))


def _steps(keys: TableReader, rng: Generator) -> Waveform:
    period = keys.number("every_s", 2.0, 1e-3)
    rise = keys.number("rise_s", min(0.05, period), 1e-3, period)
    first = keys.number("start_s", period, 0)
    return StepWave(first, period, rise, keys.word("pattern", ["turns", "stairs"], "turns") == "stairs")


def _noise(
    keys: TableReader, rng: Generator, pivot: Array, folder: Path, band: tuple[float, float], tilt: float
) -> WaveformMotion:
    """Six independent noises; tilt: 1 for the same speed at every frequency, as of a hand, with 0 at its start."""
    low, high = keys.take("band_hz", checks.pair(0, rising=True), band)
    rms = _six(keys, "rms_mm", "rms_deg", 0.0)
    waves = tuple(movements.draw_noise(low, high, tilt, rng) for _ in range(6))
    return WaveformMotion(waves, np.diag(rms), pivot, from_start=tilt > 0)


def _six(keys: TableReader, shift: str, turn: str, low: float = -math.inf) -> Array:
    """Rotation and shift (6,), rad and mm, of two keys; one of them must be there."""
    if not keys.has(shift) and not keys.has(turn):
        raise InputError(keys.where, keys.prefix + shift, "missing", f"{shift} or {turn}, 3 numbers")
    return np.concatenate([np.deg2rad(keys.vector(turn, ZERO, low)), keys.vector(shift, ZERO, low)])


def _drift(keys: TableReader, rng: Generator, pivot: Array, folder: Path) -> WaveformMotion:
    speed = np.concatenate([np.deg2rad(keys.vector("speed_deg_s", ZERO)), keys.vector("speed_mm_s", ZERO)])
    walk = np.concatenate([np.deg2rad(keys.vector("walk_deg", ZERO, 0)), keys.vector("walk_mm", ZERO, 0)])
    if not speed.any() and not walk.any():
        allowed = "speed_mm_s, speed_deg_s, walk_mm or walk_deg"
        raise InputError(keys.where, keys.prefix + "speed_mm_s", "missing", allowed)
    steady = RoundedCorners(np.zeros(1), np.ones(1), 1.0)  # from rest, at full speed after half a second
    waves: tuple[Waveform, ...] = (steady, *(movements.draw_walk(rng) for _ in range(6)))
    return WaveformMotion(waves, np.concatenate([speed[None], np.diag(walk)]), pivot)


def _ramp(keys: TableReader, rng: Generator, pivot: Array, folder: Path) -> WaveformMotion:
    speed = _six(keys, "speed_mm_s", "speed_deg_s")
    rounding = keys.number("round_s", 0.2, 1e-3)
    start = keys.number("start_s", 0.0)
    end = keys.number("end_s", math.inf, start + rounding)
    back = keys.flag("back", False)
    if math.isinf(end) and back:
        raise InputError(keys.where, keys.prefix + "end_s", "missing", "this key, where back = true")
    times, slope_changes = [start, end, 2 * end - start], [1.0, -2.0 if back else -1.0, 1.0]
    count = 1 if math.isinf(end) else 3 if back else 2
    corners = RoundedCorners(np.array(times[:count]), np.array(slope_changes[:count]), rounding)
    return WaveformMotion((corners,), speed[None], pivot)


def _constant_speed(keys: TableReader, rng: Generator, pivot: Array, folder: Path) -> WaveformMotion:
    """The thesis's cube (4.6): constant speed in all six degrees of freedom, 0.3 of both.

    Its unit is the cube's edge; the rotation's is not given, rad/s are assumed. Its motion had no end; here it returns.
    """
    unit, speed = keys.number("unit_mm", THESIS_UNIT_MM, 0, open=True), keys.number("speed_units_s", 0.3)
    turn = math.radians(keys.number("turn_deg_s", math.degrees(0.3)))
    direction, axis = (keys.vector(name, (1.0, 1.0, 1.0)) for name in ("direction", "axis"))
    travel = keys.number("travel_s", 1.0, 1e-3)
    rounding = keys.number("round_s", min(0.2, travel), 1e-3, 2 * travel)
    amplitude = np.concatenate([turn * axis, unit * speed * direction])[None]
    return WaveformMotion((Zigzag(travel, rounding),), amplitude, pivot)


def _turn(keys: TableReader, rng: Generator, pivot: Array, folder: Path) -> WaveformMotion:
    """To each angle and back, with a rest before each change; the thesis's wrist (4.6) turned by 25 and -16 degrees."""
    angles = np.array(keys.take("angles_deg", checks.array((None,), "one or more"), (25.0, -16.0)))
    if not len(angles):
        raise keys.wrong("angles_deg", "one number or more")
    axis = keys.axis("axis", SURFACE_NORMAL)
    duration, hold = keys.number("duration_s", 1.0, 1e-2), keys.number("hold_s", 1.0, 0)
    start = keys.number("start_s", hold, 0)
    starts = start + (duration + hold) * np.arange(2.0 * len(angles))
    steps = np.stack([angles, -angles], axis=1).ravel()
    period = float(starts[-1] + duration) if keys.flag("repeat", True) else math.inf
    amplitude = np.deg2rad(np.append(axis, np.zeros(3)))[None]
    return WaveformMotion((Levels(starts, steps, duration, period),), amplitude, pivot)


@dataclass(frozen=True, slots=True, eq=False)
class Levels(Waveform):
    """Changes of level, each along `ease`; 0 before the first."""

    starts: Array  # (K,) s: when each change begins
    steps: Array  # (K,): size of each change
    rise: float  # s: duration of each change
    period: float = np.inf  # s after which everything repeats (from level 0), inf for never

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        local_times = times if np.isinf(self.period) else np.where(times < 0, times, np.mod(times, self.period))
        u = (local_times[:, None] - self.starts) / self.rise
        rates = (ease_rate(u) * self.steps / self.rise).sum(axis=1)
        return np.asarray((ease(u) * self.steps).sum(axis=1)), np.asarray(rates)


@dataclass(frozen=True, slots=True, eq=False)
class RoundedCorners(Waveform):
    """Straight lines with rounded corners; the first line has slope 0."""

    times: Array  # (K,) s: when the slope changes
    slope_changes: Array  # (K,) 1/s
    rounding: float  # s: duration of each change, half of it before its time

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        x = times[:, None] - self.times
        values, rates = (curve(x, self.rounding) * self.slope_changes for curve in (corner, corner_rate))
        return np.asarray(values.sum(axis=1)), np.asarray(rates.sum(axis=1))


@dataclass(frozen=True, slots=True)
class Zigzag(Waveform):
    """A triangle wave of slope +-1 with rounded corners: 0 at t = 0, up to `reach`, down to -reach, and back."""

    reach: float  # s, as the slope is 1/s
    rounding: float  # s: at most 2 * reach

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        x, length = times - self.reach, 2 * self.reach
        values = self.reach - folded(x, length, self.rounding)
        return np.asarray(values), np.asarray(-folded_rate(x, length, self.rounding))


def _trace(keys: TableReader, rng: Generator, pivot: Array, folder: Path) -> MotionPart:
    unit = keys.take("unit", checks.word(("mm", "m")), None)
    rate = keys.take("rate_hz", checks.within(0, open=True), None)
    trace = read_trace(folder / keys.take("file", checks.text), unit, rate, keys.number("start_s", 0.0, 0))
    smooth = keys.take("smooth_s", checks.within(0), None)
    back = keys.word("loop", ["back", "hold"], "back") == "back"
    return played_trace(trace, keys.number("scale", 1.0), keys.flag("rotation", True), smooth, back, pivot)


WAVE_KINDS: dict[str, Callable[[TableReader, Generator], Waveform]] = dict(
    breathing=_breathing, pulse=_pulse, sine=_sine, steps=_steps
)
PART_KINDS: dict[str, Callable[[TableReader, Generator, Array, Path], MotionPart]] = dict(
    tremor=partial(_noise, band=(8.0, 12.0), tilt=0.0),
    hand=partial(_noise, band=(0.2, 3.0), tilt=1.0),
    **dict(drift=_drift, ramp=_ramp, constant=_constant_speed, turn=_turn, trace=_trace),
)
