"""Breathing and pulse in a smoothed motion: its spectrum along the direction in which the surface moves most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.batch.smoothed import Smoothed
from estimation.se3 import Array

BREATHING = (0.1, 0.7)  # Hz: 6 to 42 breaths a minute
PULSE = (0.75, 3.0)  # Hz: 45 to 180 beats a minute
CYCLES = 4  # of a rhythm that a recording must hold for it to be named
LONG = 10.0  # s: of a shorter recording nothing is said
CLEAR = 8.0  # times the band's own median power: a peak that stands out
HARMONIC = 0.08  # parts: a peak so near to a multiple of the breathing is the breathing's


@dataclass(frozen=True, slots=True, eq=False)
class Rhythms:
    """hertz: (F,), amplitude: (F,) mm, of the motion along `direction` (3,) in base. breathing, pulse: Hz, nan where no
    peak stands out.
    """

    hertz: Array
    amplitude: Array
    direction: Array
    breathing: float
    pulse: float


def rhythms(smoothed: Smoothed, rate: float = 30.0) -> Rhythms:
    """The spectrum (Hann window) of the origin's position, resampled at `rate` Hz."""
    first, last = smoothed.stamps[[0, -1]]
    times = np.arange(first, last, 1 / rate)
    positions = smoothed.at(times).base_from_surface[:, :3, 3]
    centred = positions - positions.mean(0)
    direction = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    along = centred @ direction
    along = along - np.polyval(np.polyfit(times - first, along, 1), times - first)
    window = np.hanning(len(along))
    hertz = np.asarray(np.fft.rfftfreq(len(along), 1 / rate), float)
    amplitude = np.asarray(2 * np.abs(np.fft.rfft(along * window)) / max(window.sum(), 1e-9), float)
    breathing = _peak(hertz, amplitude, BREATHING, last - first)
    pulse = _peak(hertz, amplitude, PULSE, last - first, breathing)
    return Rhythms(hertz, amplitude, direction, breathing, pulse)


def _peak(
    hertz: Array, amplitude: Array, band: tuple[float, float], seconds: float, apart_from: float = float("nan")
) -> float:
    """The clearest peak of a band, Hz, or nan; not a multiple of `apart_from`."""
    inside = (hertz >= max(band[0], CYCLES / seconds)) & (hertz <= band[1])
    if np.isfinite(apart_from):
        times = hertz / apart_from
        inside &= np.abs(times - np.round(times)) > HARMONIC * np.maximum(1.0, times / 4)
    peaks = np.zeros(len(hertz), bool)
    peaks[1:-1] = (amplitude[1:-1] > amplitude[:-2]) & (amplitude[1:-1] >= amplitude[2:])
    found = np.flatnonzero(inside & peaks)
    if not len(found) or seconds < LONG:
        return float("nan")
    best = found[amplitude[found].argmax()]
    clear = amplitude[best] ** 2 > CLEAR * np.median(amplitude[(hertz >= band[0]) & (hertz <= band[1])] ** 2)
    return float(hertz[best]) if clear else float("nan")
