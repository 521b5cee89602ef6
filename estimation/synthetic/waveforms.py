"""Scalar functions of time that drive the simulated world: unit amplitude, smooth, with their exact derivatives.

Every random draw is made when a waveform is built; afterwards it depends on the time alone, which may be any.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from estimation.se3 import Array

WALK_SECONDS = 600  # how long a random walk goes on before it comes back the way it went


class Waveform(Protocol):
    """A smooth scalar function of time with its derivative."""

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        ...

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s, at times (N,), s."""
        ...


def ease(u: Array) -> Array:
    """0 before u = 0, 1 after u = 1 and between them the quintic with no speed and no acceleration at its ends."""
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
    """sin(2 pi rate t + phase). rate_hz: Hz. phase: rad."""

    rate_hz: float
    phase: float = 0.0

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.sin(2 * np.pi * self.rate_hz * times + self.phase)

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        omega = 2 * np.pi * self.rate_hz
        return np.asarray(omega * np.cos(omega * times + self.phase))


@dataclass(frozen=True, slots=True)
class Bump:
    """A rise from 0 and a fall back to it within one cycle, skewed: sin^exponent about the peak.

    start, peak, end: shares of the cycle, 0 <= start < peak < end <= 1. exponent: >= 2; the larger, the longer the
    rest at both ends. height: of the peak.
    """

    start: float
    peak: float
    end: float
    exponent: float
    height: float = 1.0

    def __call__(self, u: Array) -> Array:
        """Values (N,) at phases u (N,) of the cycle, 0 to 1."""
        return np.asarray(self.height * np.sin(self._angle(u)[0]) ** self.exponent)

    def rate(self, u: Array) -> Array:
        """Derivatives (N,) by the phase."""
        angle, slope = self._angle(u)
        return np.asarray(self.height * self.exponent * np.sin(angle) ** (self.exponent - 1) * np.cos(angle) * slope)

    def _angle(self, u: Array) -> tuple[Array, Array]:
        """0 at the start, pi/2 at the peak, pi at the end, linear between: its kink stands where the slope is 0."""
        u = np.clip(u, self.start, self.end)
        slope = np.pi / 2 / np.where(u < self.peak, self.peak - self.start, self.end - self.peak)
        return np.clip(np.pi / 2 + (u - self.peak) * slope, 0.0, np.pi), slope


PULSE_BUMPS = (Bump(0.0, 0.15, 0.55, 2.0), Bump(0.38, 0.5, 0.95, 2.0, 0.35))  # systole; the wave after the notch


def breath_bumps(inspiration: float, exponent: float) -> tuple[Bump, ...]:
    """One breath: up within the share `inspiration` of it, down in the rest of it, still at end-expiration.

    sin^exponent is the cos^2n of Lujan et al., Med Phys 26:715 (1999), with the two halves of unequal length.
    """
    return (Bump(0.0, inspiration, 1.0, exponent),)


@dataclass(frozen=True, slots=True, eq=False)
class Cycles:
    """Cycles of one shape, each with its own start, length and depth; between two of them it rests at 0.

    starts: (K + 1,) s, starts[0] = 0 and the last one is where the draw begins again from the first. lengths: (K,) s,
    at most the step to the next start. depths: (K,). bumps: of a cycle of depth 1.
    """

    starts: Array
    lengths: Array
    depths: Array
    bumps: tuple[Bump, ...]

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
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
class Noise:
    """A sum of sines of random frequency and phase. omegas, amplitudes, phases: (M,) rad/s, 1, rad."""

    omegas: Array
    amplitudes: Array
    phases: Array

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.asarray((np.sin(np.outer(times, self.omegas) + self.phases) * self.amplitudes).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        slopes = np.cos(np.outer(times, self.omegas) + self.phases) * (self.amplitudes * self.omegas)
        return np.asarray(slopes.sum(axis=1))


@dataclass(frozen=True, slots=True)
class Steps:
    """A step every so often, each along `ease`. first: s, its start. every, rise: s, rise <= every.

    stairs: each goes up by 1; else they go up and down in turn.
    """

    first: float
    every: float
    rise: float
    stairs: bool

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
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
        """Steps done before the present one, and phase of the present one."""
        since = times - self.first
        done = np.maximum(np.floor(since / self.every), 0.0)
        return done, (since - done * self.every) / self.rise


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """From level to level along `ease`, 0 before the first. starts, steps: (K,) s and 1, when each change begins and
    how far it goes. rise: s. period: s after which it all begins again (from 0 to 0), inf for never."""

    starts: Array
    steps: Array
    rise: float
    period: float = np.inf

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.asarray((ease(self._phase(times)) * self.steps).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray((ease_rate(self._phase(times)) * self.steps / self.rise).sum(axis=1))

    def _phase(self, times: Array) -> Array:
        within = times if np.isinf(self.period) else np.where(times < 0, times, np.mod(times, self.period))
        return np.asarray((within[:, None] - self.starts) / self.rise)


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Straight lines with rounded corners: the slope is 0 and changes by `bends` (K,), 1/s, at `times` (K,), s.

    rounding: s, how long each change of slope takes, half of it before its time.
    """

    times: Array
    bends: Array
    rounding: float

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.asarray((corner(times[:, None] - self.times, self.rounding) * self.bends).sum(axis=1))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray((corner_rate(times[:, None] - self.times, self.rounding) * self.bends).sum(axis=1))


@dataclass(frozen=True, slots=True)
class Zigzag:
    """There and back at slope +-1: 0 at t = 0, up to `reach` (s, so that it goes at 1/s), to -reach and back, with
    corners rounded over `rounding`, s, at most 2 * reach."""

    reach: float
    rounding: float

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.asarray(self.reach - folded(times - self.reach, 2 * self.reach, self.rounding))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        return np.asarray(-folded_rate(times - self.reach, 2 * self.reach, self.rounding))


def folded(x: Array, length: float, rounding: float) -> Array:
    """Distance (N,) from x to the nearest even multiple of `length`, 0 to `length`, its corners rounded."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    low, high = y, y - length
    return np.where(
        y < length / 2,
        2 * corner(low, rounding) - low,
        length - (2 * corner(high, rounding) - high),
    )


def folded_rate(x: Array, length: float, rounding: float) -> Array:
    """Derivative of `folded`."""
    y = np.mod(x + length / 2, 2 * length) - length / 2
    return np.where(y < length / 2, 2 * corner_rate(y, rounding) - 1, 1 - 2 * corner_rate(y - length, rounding))


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A smoothed random walk that goes back the way it came after WALK_SECONDS. spline: from 0 at 0 s, flat ends."""

    spline: CubicSpline

    def __call__(self, times: Array) -> Array:
        """Values (N,) at times (N,), s."""
        return np.asarray(self.spline(self._mirrored(times)))

    def rate(self, times: Array) -> Array:
        """Derivatives (N,), 1/s."""
        sign = np.where(np.mod(times, 2 * WALK_SECONDS) < WALK_SECONDS, 1.0, -1.0)
        return np.asarray(sign * self.spline(self._mirrored(times), 1))

    def _mirrored(self, times: Array) -> Array:
        return np.asarray(WALK_SECONDS - np.abs(np.mod(times, 2 * WALK_SECONDS) - WALK_SECONDS))
