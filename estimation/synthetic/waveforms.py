"""Scalar functions of time that drive simulated motion: unit amplitude, smooth, with exact derivatives.

Random numbers are drawn when a waveform is made; after that its value depends on the time alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from estimation.se3 import Array

WALK_SECONDS = 600  # length of a random walk; after it the walk is played backwards


class Waveform:
    """A smooth scalar function of time with its derivative; each kind computes both in `_evaluate`."""

    __slots__ = ()

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return self._evaluate(times)[0]

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s, at times (N,), s."""
        return self._evaluate(times)[1]

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        raise NotImplementedError


def ease(u: Array) -> Array:
    """0 before u = 0, 1 after u = 1, and between them the quintic with zero speed and acceleration at its ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10 + u * (6 * u - 15)))


def ease_rate(u: Array) -> Array:
    """Derivative of `ease`; never above 1.875."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(30 * (u * (1 - u)) ** 2)


def corner(x: Array, rounding: float) -> Array:
    """max(x, 0) with its corner rounded over `rounding` about 0: exact outside, second derivative continuous."""
    u = np.clip(x / rounding + 0.5, 0.0, 1.0)
    return np.asarray(rounding * u**3 * (1 - u / 2) + np.maximum(x - rounding / 2, 0.0))


def corner_rate(x: Array, rounding: float) -> Array:
    """Derivative of `corner`: 0 to 1 along the cubic smoothstep."""
    u = np.clip(x / rounding + 0.5, 0.0, 1.0)
    return np.asarray(u * u * (3 - 2 * u))


@dataclass(frozen=True, slots=True)
class Sine(Waveform):
    """sin(2 pi rate t + phase)."""

    rate_hz: float
    phase: float = 0.0  # rad

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        omega = 2 * np.pi * self.rate_hz
        return np.sin(omega * times + self.phase), np.asarray(omega * np.cos(omega * times + self.phase))


@dataclass(frozen=True, slots=True)
class Bump:
    """A rise from 0 and a fall back within one cycle: sin^exponent about a peak that need not be in the middle."""

    start: float  # share of the cycle, as peak and end: 0 <= start < peak < end <= 1
    peak: float
    end: float
    exponent: float  # >= 2; larger values stay longer near 0 at both ends
    height: float = 1.0  # of the peak

    def __call__(self, u: Array) -> tuple[Array, Array]:
        """Values (N,) at phases u (N,), and their derivatives (N,) by the phase."""
        u = np.clip(u, self.start, self.end)
        # the angle is 0 at the start, pi/2 at the peak, pi at the end, linear between: it bends where sin has no slope
        slope = np.pi / 2 / np.where(u < self.peak, self.peak - self.start, self.end - self.peak)
        angle = np.clip(np.pi / 2 + (u - self.peak) * slope, 0.0, np.pi)
        value = np.asarray(self.height * np.sin(angle) ** self.exponent)
        rate = self.height * self.exponent * np.sin(angle) ** (self.exponent - 1) * np.cos(angle) * slope
        return value, np.asarray(rate)


PULSE_BUMPS = (Bump(0.0, 0.15, 0.55, 2.0), Bump(0.38, 0.5, 0.95, 2.0, 0.35))  # systole; the wave after the notch


@dataclass(frozen=True, slots=True, eq=False)
class Cycles(Waveform):
    """Cycles of one shape, each with its own start, length and depth; 0 between them."""

    starts: Array  # (K + 1,) s, starts[0] = 0; at the last one everything repeats from the first
    lengths: Array  # (K,) s, at most up to the next start
    depths: Array  # (K,)
    bumps: tuple[Bump, ...]  # of a cycle of depth 1

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        within = np.mod(times, self.starts[-1])
        k = np.clip(np.searchsorted(self.starts, within, side="right") - 1, 0, len(self.lengths) - 1)
        u = np.clip((within - self.starts[k]) / self.lengths[k], 0.0, 1.0)
        values, rates = zip(*(bump(u) for bump in self.bumps), strict=True)
        return np.asarray(self.depths[k] * sum(values)), np.asarray(self.depths[k] / self.lengths[k] * sum(rates))


@dataclass(frozen=True, slots=True, eq=False)
class BandNoise(Waveform):
    """A sum of sines of random frequency and phase."""

    omegas: Array  # (M,) rad/s
    amplitudes: Array  # (M,)
    phases: Array  # (M,) rad

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        angles = np.outer(times, self.omegas) + self.phases
        values, rates = np.sin(angles) * self.amplitudes, np.cos(angles) * (self.amplitudes * self.omegas)
        return np.asarray(values.sum(axis=1)), np.asarray(rates.sum(axis=1))


@dataclass(frozen=True, slots=True)
class StepWave(Waveform):
    """Periodic steps, each along `ease`."""

    first: float  # s: start of the first step
    every: float  # s: period
    rise: float  # s: duration of a step, at most `every`
    stairs: bool  # True: every step goes up by 1; False: up and down in turn

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        since = times - self.first
        done = np.maximum(np.floor(since / self.every), 0.0)
        u = (since - done * self.every) / self.rise
        up, speed = ease(u), ease_rate(u) / self.rise
        if self.stairs:
            return np.asarray(done + up), speed
        rises = done % 2 == 0
        return np.where(rises, up, 1 - up), np.where(rises, speed, -speed)


@dataclass(frozen=True, slots=True, eq=False)
class Levels(Waveform):
    """Changes of level, each along `ease`; 0 before the first."""

    starts: Array  # (K,) s: when each change begins
    steps: Array  # (K,): size of each change
    rise: float  # s: duration of each change
    period: float = np.inf  # s after which everything repeats (from level 0), inf for never

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        within = times if np.isinf(self.period) else np.where(times < 0, times, np.mod(times, self.period))
        u = (within[:, None] - self.starts) / self.rise
        rates = (ease_rate(u) * self.steps / self.rise).sum(axis=1)
        return np.asarray((ease(u) * self.steps).sum(axis=1)), np.asarray(rates)


@dataclass(frozen=True, slots=True, eq=False)
class RoundedCorners(Waveform):
    """Straight lines with rounded corners; the first line has slope 0."""

    times: Array  # (K,) s: when the slope changes
    bends: Array  # (K,) 1/s: change of the slope
    rounding: float  # s: duration of each change, half of it before its time

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        x = times[:, None] - self.times
        values, rates = corner(x, self.rounding) * self.bends, corner_rate(x, self.rounding) * self.bends
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


def folded(x: Array, length: float, rounding: float) -> Array:
    """Distance (N,) from x to the nearest even multiple of `length`, 0 to `length`, with rounded corners."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    high = y - length
    return np.where(y < length / 2, 2 * corner(y, rounding) - y, length - (2 * corner(high, rounding) - high))


def folded_rate(x: Array, length: float, rounding: float) -> Array:
    """Derivative of `folded`."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    return np.where(y < length / 2, 2 * corner_rate(y, rounding) - 1, 1 - 2 * corner_rate(y - length, rounding))


@dataclass(frozen=True, slots=True, eq=False)
class Walk(Waveform):
    """A smoothed random walk, played backwards after WALK_SECONDS."""

    spline: CubicSpline  # 0 at 0 s, zero slope at both ends

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        within = np.mod(times, 2 * WALK_SECONDS)
        mirrored = WALK_SECONDS - np.abs(within - WALK_SECONDS)
        sign = np.where(within < WALK_SECONDS, 1.0, -1.0)
        return np.asarray(self.spline(mirrored)), np.asarray(sign * self.spline(mirrored, 1))
