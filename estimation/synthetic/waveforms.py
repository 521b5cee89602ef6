"""Scalar functions of time that drive simulated motion: unit amplitude, smooth, with exact derivatives.

Random numbers are drawn when a waveform is made; after that its value depends on the time alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from estimation.se3 import Array

WALK_SECONDS = 600  # length of a random walk; after it the walk is played backwards


class Waveform(Protocol):
    """A smooth scalar function of time with its derivative."""

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s, at times (N,), s."""


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
class Sine:
    """sin(2 pi rate t + phase)."""

    rate_hz: float
    phase: float = 0.0  # rad

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.sin(2 * np.pi * self.rate_hz * times + self.phase)

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        omega = 2 * np.pi * self.rate_hz
        return np.asarray(omega * np.cos(omega * times + self.phase))


@dataclass(frozen=True, slots=True)
class Bump:
    """A rise from 0 and a fall back within one cycle: sin^exponent about a peak that need not be in the middle."""

    start: float  # share of the cycle, as peak and end: 0 <= start < peak < end <= 1
    peak: float
    end: float
    exponent: float  # >= 2; larger values stay longer near 0 at both ends
    height: float = 1.0  # of the peak

    def __call__(self, u: Array) -> Array:
        """Values (N,)."""
        return np.asarray(self.height * np.sin(self._angle(u)[0]) ** self.exponent)

    def rate(self, u: Array) -> Array:
        """Derivatives (N,) by the phase."""
        angle, slope = self._angle(u)
        return np.asarray(self.height * self.exponent * np.sin(angle) ** (self.exponent - 1) * np.cos(angle) * slope)

    def _angle(self, u: Array) -> tuple[Array, Array]:
        """0 at the start, pi/2 at the peak, pi at the end, linear between: the kink is where sin has zero slope."""
        u = np.clip(u, self.start, self.end)
        slope = np.pi / 2 / np.where(u < self.peak, self.peak - self.start, self.end - self.peak)
        return np.clip(np.pi / 2 + (u - self.peak) * slope, 0.0, np.pi), slope


PULSE_BUMPS = (Bump(0.0, 0.15, 0.55, 2.0), Bump(0.38, 0.5, 0.95, 2.0, 0.35))  # systole; the wave after the notch


def breath_bumps(inspiration: float, exponent: float) -> tuple[Bump, ...]:
    """One breath: up within the share `inspiration`, then down; at rest at end-expiration.

    sin^exponent is cos^2n of Lujan et al., Med Phys 26:715 (1999), with two halves of unequal length.
    """
    return (Bump(0.0, inspiration, 1.0, exponent),)


@dataclass(frozen=True, slots=True, eq=False)
class Cycles:
    """Cycles of one shape, each with its own start, length and depth; 0 between them."""

    starts: Array  # (K + 1,) s, starts[0] = 0; at the last one everything repeats from the first
    lengths: Array  # (K,) s, at most up to the next start
    depths: Array  # (K,)
    bumps: tuple[Bump, ...]  # of a cycle of depth 1

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        k, u = self._phase(times)
        return np.asarray(self.depths[k] * sum(bump(u) for bump in self.bumps))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        k, u = self._phase(times)
        return np.asarray(self.depths[k] / self.lengths[k] * sum(bump.rate(u) for bump in self.bumps))

    def _phase(self, times: Array) -> tuple[Array, Array]:
        within = np.mod(times, self.starts[-1])
        k = np.clip(np.searchsorted(self.starts, within, side="right") - 1, 0, len(self.lengths) - 1)
        return k, np.clip((within - self.starts[k]) / self.lengths[k], 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class BandNoise:
    """A sum of sines of random frequency and phase."""

    omegas: Array  # (M,) rad/s
    amplitudes: Array  # (M,)
    phases: Array  # (M,) rad

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.asarray((np.sin(np.outer(times, self.omegas) + self.phases) * self.amplitudes).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        slopes = np.cos(np.outer(times, self.omegas) + self.phases) * (self.amplitudes * self.omegas)
        return np.asarray(slopes.sum(axis=1))


@dataclass(frozen=True, slots=True)
class StepWave:
    """Periodic steps, each along `ease`."""

    first: float  # s: start of the first step
    every: float  # s: period
    rise: float  # s: duration of a step, at most `every`
    stairs: bool  # True: every step goes up by 1; False: up and down in turn

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        done, u = self._phase(times)
        if self.stairs:
            return np.asarray(done + ease(u))
        return np.where(done % 2 == 0, ease(u), 1 - ease(u))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        done, u = self._phase(times)
        sign = 1.0 if self.stairs else np.where(done % 2 == 0, 1.0, -1.0)
        return np.asarray(sign * ease_rate(u) / self.rise)

    def _phase(self, times: Array) -> tuple[Array, Array]:
        since = times - self.first
        done = np.maximum(np.floor(since / self.every), 0.0)
        return done, (since - done * self.every) / self.rise


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Changes of level, each along `ease`; 0 before the first."""

    starts: Array  # (K,) s: when each change begins
    steps: Array  # (K,): size of each change
    rise: float  # s: duration of each change
    period: float = np.inf  # s after which everything repeats (from level 0), inf for never

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.asarray((ease(self._phase(times)) * self.steps).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray((ease_rate(self._phase(times)) * self.steps / self.rise).sum(axis=1))

    def _phase(self, times: Array) -> Array:
        within = times if np.isinf(self.period) else np.where(times < 0, times, np.mod(times, self.period))
        return np.asarray((within[:, None] - self.starts) / self.rise)


@dataclass(frozen=True, slots=True, eq=False)
class RoundedCorners:
    """Straight lines with rounded corners; the first line has slope 0."""

    times: Array  # (K,) s: when the slope changes
    bends: Array  # (K,) 1/s: change of the slope
    rounding: float  # s: duration of each change, half of it before its time

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.asarray((corner(times[:, None] - self.times, self.rounding) * self.bends).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray((corner_rate(times[:, None] - self.times, self.rounding) * self.bends).sum(axis=1))


@dataclass(frozen=True, slots=True)
class Zigzag:
    """A triangle wave of slope +-1 with rounded corners: 0 at t = 0, up to `reach`, down to -reach, and back."""

    reach: float  # s, as the slope is 1/s
    rounding: float  # s: at most 2 * reach

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.asarray(self.reach - folded(times - self.reach, 2 * self.reach, self.rounding))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray(-folded_rate(times - self.reach, 2 * self.reach, self.rounding))


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
class Walk:
    """A smoothed random walk, played backwards after WALK_SECONDS."""

    spline: CubicSpline  # 0 at 0 s, zero slope at both ends

    def __call__(self, times: Array) -> Array:
        """Values (N,)."""
        return np.asarray(self.spline(self._mirrored(times)))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        sign = np.where(np.mod(times, 2 * WALK_SECONDS) < WALK_SECONDS, 1.0, -1.0)
        return np.asarray(sign * self.spline(self._mirrored(times), 1))

    def _mirrored(self, times: Array) -> Array:
        return np.asarray(WALK_SECONDS - np.abs(np.mod(times, 2 * WALK_SECONDS) - WALK_SECONDS))
