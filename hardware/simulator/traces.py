"""Recorded motions as parts of a simulated one: smoothed, interpolated, played there and back or held at the end."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from estimation.synthetic.waveforms import corner, corner_rate, folded, folded_rate
from hardware.simulator.trace_file import Trace

SMOOTH_STEPS = 5  # of the trace's own: periods below are taken away, on the 10 Hz chests 0.03-0.1 mm, their noise
WIDEST_TURN = math.radians(150)  # from the first pose: rotation vectors are interpolated, which end at 180
STOP = 0.5  # s in which the play turns round or comes to its end


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """A trace as a part of a motion. spline: s -> (N, 6) rotation vector and shift, rad and mm. duration: s, of it.

    back: whether it is played there and back for ever; else it stops at the end. pivot: (3,) mm.
    """

    spline: CubicSpline
    duration: float
    back: bool
    pivot: Array

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm."""
        return np.asarray(self.spline(self._place(times)))

    def rates(self, times: Array) -> Array:
        """Their derivatives (N, 6)."""
        return np.asarray(self.spline(self._place(times), 1) * self._speed(times)[:, None])

    def _place(self, times: Array) -> Array:
        """Where in the trace, s: at 0 s at its beginning and at its own speed, before that slowly out of rest."""
        first = corner(times + STOP / 2, STOP) - STOP / 2 - corner(times - self.duration + STOP / 2, STOP)
        return np.where(self._again(times), folded(times, self.duration, STOP), first)

    def _speed(self, times: Array) -> Array:
        first = corner_rate(times + STOP / 2, STOP) - corner_rate(times - self.duration + STOP / 2, STOP)
        return np.where(self._again(times), folded_rate(times, self.duration, STOP), first)

    def _again(self, times: Array) -> Array:
        return np.asarray(self.back & (times > self.duration / 2))


def traced(trace: Trace, scale: float, rotation: bool, smooth: float | None, back: bool, pivot: Array) -> Traced:
    """A trace as a part: its shifts and rotations times `scale`, without the rotations where `rotation` is false.

    smooth: s, the period at which the low-pass keeps half (Butterworth of second order, forward and back, so without
    delay): of 0.1 mm noise at 10 Hz an interpolating spline would make speeds of mm/s that no chest had. None takes
    SMOOTH_STEPS of the trace's own steps, 0 nothing.
    """
    step, zero = float(np.median(np.diff(trace.stamps))), np.zeros((len(trace.stamps), 3))
    smooth = SMOOTH_STEPS * step if smooth is None else smooth
    coordinates = np.concatenate([_rotation_vectors(trace) if rotation else zero, trace.poses[:, :3, 3]], axis=1)
    duration = float(trace.stamps[-1])
    if duration < 2 * STOP:
        raise InputError(trace.where, "duration", f"{duration:g} s", f"{2 * STOP:g} s or more")
    stamps = trace.stamps
    if smooth > 0:
        if smooth < 2.5 * step:
            raise InputError(
                trace.where, "smooth_s", smooth, f"0, or at least 2.5 steps of the trace, {2.5 * step:g} s"
            )
        stamps, coordinates = _smoothed(stamps, coordinates, step, smooth)
    coordinates = coordinates - coordinates[0]  # the filter moves the first sample too
    return Traced(CubicSpline(stamps, scale * coordinates), duration, back, pivot)


def _rotation_vectors(trace: Trace) -> Array:
    vectors = se3.log_rotation(trace.poses[:, :3, :3])
    widest = float(np.linalg.norm(vectors, axis=1).max())
    if widest > WIDEST_TURN:
        got = f"{math.degrees(widest):.0f} degrees from the pose at its start"
        raise InputError(trace.where, "rotation", got, f"at most {math.degrees(WIDEST_TURN):.0f}; or rotation = false")
    return vectors


def _smoothed(stamps: Array, coordinates: Array, step: float, smooth: float) -> tuple[Array, Array]:
    """Resampled to even steps and low-passed: stamps (M,) and coordinates (M, 6)."""
    count = max(8, round(stamps[-1] / step) + 1)
    even = np.linspace(0.0, stamps[-1], count)
    values = CubicSpline(stamps, coordinates)(even)
    # of two passes each keeps 1 / sqrt(2) of the amplitude at its corner frequency
    b, a = butter(2, 1 / smooth, fs=(count - 1) / stamps[-1])
    return even, np.asarray(filtfilt(b, a, values, axis=0, padlen=min(count - 1, 3 * round(smooth / step) + 6)))
