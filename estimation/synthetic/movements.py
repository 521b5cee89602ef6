"""Movements of synthetic surfaces by name (chests, hands, test benches), and the waveforms that drive them.

A movement is a displacement of the surface from its rest pose: an exact, smooth function of time. Its numbers are
measured ones: breathing of 10 mm and 3 degrees at 15 breaths a minute with a pulse; the thesis's shaking table (4.6)
and its steps of 300 um (main requirement). Random numbers are drawn when a waveform is made; after that its value
depends on the time alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from estimation import se3
from estimation.runtime import CubicCurve
from estimation.se3 import Array

WALK_SECONDS = 600  # length of a random walk; after it the walk is played backwards
FRAMES_PER_S = 29.91  # of the camera above the thesis's shaking table (thesis 4.6)
DRAWN_SECONDS = 600.0  # length of the drawn breaths and beats; then they repeat, at rest as they began
MAX_DRAW_SIGMAS = 2.5  # standard deviations at which a draw is cut, so that every amplitude is bounded
NOISE_SINES = 48  # in a band: enough that no beat between two of them stands out
SIGH_LENGTH = 1.5  # times the length of a breath
BREATH_SIZE = (0.045, 0.01, 0.004, 1.2, 2.5, 9.6)  # rad, mm: about 3 degrees, 10 mm, most of it along the normal
DRIFT_RMS = (0.0, 0.0, 0.003, 0.6, 0.6, 0.4)  # rad, mm: RMS after a minute
PULSE_SIZE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.15)  # mm
UNIT_AXES = np.eye(6)


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
class Walk(Waveform):
    """A smoothed random walk, played backwards after WALK_SECONDS."""

    curve: CubicCurve  # 0 at 0 s, zero slope at both ends

    def _evaluate(self, times: Array) -> tuple[Array, Array]:
        within = np.mod(times, 2 * WALK_SECONDS)
        mirrored = WALK_SECONDS - np.abs(within - WALK_SECONDS)
        sign = np.where(within < WALK_SECONDS, 1.0, -1.0)
        values, rates = self.curve(mirrored)
        return values, sign * rates


class MotionPart(Protocol):
    """One displacement: a rotation about a pivot and a shift, each a smooth function of time."""

    @property
    def pivot(self) -> Array:
        """Fixed point (3,) of the rotation, mm, rest frame."""

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm, at times (N,), s."""

    def rates(self, times: Array) -> Array:
        """Derivatives (N, 6) of the coordinates, 1/s."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveformMotion:
    """A sum of waveforms, each along its own direction."""

    waveforms: tuple[Waveform, ...]
    directions: Array  # (W, 6) [rx ry rz tx ty tz], rad and mm per unit of the waveform
    pivot: Array  # (3,) mm
    from_start: bool = False  # whether the coordinates are 0 at 0 s

    def coordinates(self, times: Array) -> Array:
        """Rotation vector and shift (N, 6), rad and mm."""
        values = self._values(times)
        return weighted_sum(values - self._values(np.zeros(1)) if self.from_start else values, self.directions)

    def rates(self, times: Array) -> Array:
        """Their derivatives (N, 6)."""
        return weighted_sum(np.stack([w.rate(times) for w in self.waveforms], axis=-1), self.directions)

    def _values(self, times: Array) -> Array:
        return np.stack([w(times) for w in self.waveforms], axis=-1)


@dataclass(frozen=True, slots=True)
class ComposedMotion:
    """Displacements composed in order: base_from_surface = base_from_rest @ motion(times)."""

    parts: tuple[MotionPart, ...]

    def __call__(self, times: ArrayLike) -> Array:
        """rest_from_surface (..., 4, 4), mm, at times (...), s."""
        times = np.asarray(times, float)
        flat = times.reshape(-1)
        out = np.broadcast_to(np.eye(4), (len(flat), 4, 4))
        for part in self.parts:
            out = out @ _transform(part.coordinates(flat), part.pivot)
        return np.array(out).reshape(*times.shape, 4, 4)

    def twist(self, times: ArrayLike) -> Array:
        """Exact body velocity (..., 6) of the surface, rad/s and mm/s, at times (...), s."""
        times = np.asarray(times, float)
        flat = times.reshape(-1)
        out = np.zeros((len(flat), 6))
        for part in self.parts:
            coordinates = part.coordinates(flat)
            carry = se3.adjoint(se3.inverse(_transform(coordinates, part.pivot)))
            out = (carry @ out[..., None])[..., 0] + _body_twist(coordinates, part.rates(flat), part.pivot)
        return out.reshape(*times.shape, 6)


def weighted_sum(values: Array, directions: Array) -> Array:
    """values (N, W) @ directions (W, 6), summed in one order whatever N is: one instant alone gives the same bits."""
    return np.asarray((values[:, :, None] * directions).sum(axis=1))


def _transform(coordinates: Array, pivot: Array) -> Array:
    rotation = se3.exp_rotation(coordinates[:, :3])
    return se3.make(rotation, coordinates[:, 3:] + pivot - rotation @ pivot)


def _body_twist(coordinates: Array, rates: Array, pivot: Array) -> Array:
    """Twist (N, 6) of x -> R (x - pivot) + pivot + shift, R = exp(w): [omega, R^T shift' - omega x pivot].

    omega is w' times the right Jacobian of SO(3) at w, which is the left one at -w (Barfoot 2017, 7.1.5).
    """
    w, w_rate = coordinates[:, :3], rates[:, :3]
    omega = se3.exp(np.concatenate([-w, w_rate], axis=-1))[:, :3, 3]  # exp shifts by the left Jacobian of w
    rotation = se3.exp_rotation(w)
    shift = np.squeeze(np.swapaxes(rotation, -1, -2) @ rates[:, 3:, None], -1)
    return np.concatenate([omega, shift - np.cross(omega, pivot)], axis=-1)


def shaking_amplitude(mm_per_frame: float, rate_hz: float, frames_per_s: float = FRAMES_PER_S) -> float:
    """Amplitude, mm, of a sine that moves `mm_per_frame` between two frames on average.

    The thesis (4.6) gives its shaking table's distance per frame of a 29.91 fps camera: 0.08 mm at 0.1 Hz and 0.47 mm
    at 0.5 Hz. A sine of amplitude A moves 4 A per cycle, 4 A rate / fps per frame: A = 5.98 mm and 7.03 mm. Read as
    the largest distance (2 pi A rate / fps) it would be 3.81 mm and 4.47 mm; no reading makes the two equal.
    """
    return mm_per_frame * frames_per_s / (4 * rate_hz)


@dataclass(frozen=True, slots=True)
class BreathingSpec:
    """A breathing pattern; the default is irregular spontaneous breathing."""

    period: float = 4.0  # s
    inspiration: float = 0.4  # share of the period
    exponent: float = 4.0  # of sin, the shape of a breath
    period_spread: float = 0.10  # relative standard deviation per breath
    depth_spread: float = 0.15  # relative standard deviation per breath
    sighs_per_min: float = 0.0
    sigh_factor: float = 2.0  # depth of a sigh, in usual depths
    pauses_per_min: float = 0.0
    pause: float = 5.0  # s: length of a pause, at end-expiration


def draw_breathing(spec: BreathingSpec, rng: np.random.Generator) -> Cycles:
    """Breaths from end-expiration (0) to the depth of a usual breath (1) and back; the first begins at 0 s."""
    count = int(np.ceil(DRAWN_SECONDS / spec.period))
    lengths = spec.period * (1 + spec.period_spread * _bounded(rng, count))
    depths = 1 + spec.depth_spread * _bounded(rng, count)
    sighs = rng.random(count) < spec.sighs_per_min * spec.period / 60
    pauses = rng.random(count) < spec.pauses_per_min * spec.period / 60
    lengths = np.where(sighs, SIGH_LENGTH * lengths, lengths)
    depths = np.where(sighs, spec.sigh_factor * depths, depths)
    starts = np.concatenate([[0.0], np.cumsum(lengths + np.where(pauses, spec.pause, 0.0))])
    # sin^exponent is cos^2n of Lujan et al., Med Phys 26:715 (1999), with two halves of unequal length
    return Cycles(starts, lengths, depths, (Bump(0.0, spec.inspiration, 1.0, spec.exponent),))


def draw_pulse(rate_hz: float, rate_spread: float, depth_spread: float, rng: np.random.Generator) -> Cycles:
    """Heartbeats of height 1: a steep rise, a notch and a smaller wave after it; spreads are relative, per beat."""
    count = int(np.ceil(DRAWN_SECONDS * rate_hz))
    lengths = (1 + rate_spread * _bounded(rng, count)) / rate_hz
    depths = 1 + depth_spread * _bounded(rng, count)
    return Cycles(np.concatenate([[0.0], np.cumsum(lengths)]), lengths, depths, PULSE_BUMPS)


def draw_noise(low_hz: float, high_hz: float, tilt: float, rng: np.random.Generator) -> BandNoise:
    """Noise of unit RMS between two frequencies, amplitudes falling with the frequency to the power `tilt`."""
    edges = np.linspace(low_hz, high_hz, NOISE_SINES + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    amplitudes = frequencies**-tilt
    amplitudes *= np.sqrt(2 / np.sum(amplitudes**2))
    return BandNoise(2 * np.pi * frequencies, amplitudes, rng.uniform(0, 2 * np.pi, NOISE_SINES))


def draw_walk(rng: np.random.Generator) -> Walk:
    """A random walk from 0 with an RMS of 1 after a minute (and of 2 after four), smooth over a second."""
    knots = np.arange(WALK_SECONDS + 1.0)
    values = np.concatenate([[0.0], np.cumsum(rng.standard_normal(WALK_SECONDS)) / np.sqrt(60)])
    return Walk(CubicCurve(knots, values, at_rest=True))


def _bounded(rng: np.random.Generator, count: int) -> Array:
    return np.clip(rng.standard_normal(count), -MAX_DRAW_SIGMAS, MAX_DRAW_SIGMAS)


Movement = Callable[[np.random.Generator], ComposedMotion]


def still(rng: np.random.Generator) -> ComposedMotion:
    """No movement."""
    return ComposedMotion(())


def breathing(rng: np.random.Generator) -> ComposedMotion:
    """Calm breathing: 10 mm and 3 degrees, each breath a little different, with a slow drift and a pulse."""
    return _breathing(BreathingSpec(period_spread=0.03, depth_spread=0.05), rng)


def irregular(rng: np.random.Generator) -> ComposedMotion:
    """Spontaneous breathing: each breath 10 % longer or shorter and 15 % deeper or flatter."""
    return _breathing(BreathingSpec(), rng)


def shaker(rng: np.random.Generator) -> ComposedMotion:
    """The thesis's shaking table at 0.5 Hz: a sine of 7 mm across the surface, up to 22 mm/s."""
    amplitude = shaking_amplitude(0.47, 0.5)
    return _driven([Sine(0.5, float(rng.uniform(0, 2 * np.pi)))], [amplitude * UNIT_AXES[3]])


def steps(rng: np.random.Generator) -> ComposedMotion:
    """Rest, and every second a step of 0.3 mm along the normal, up and down in turn, within 50 ms."""
    return _driven([StepWave(float(rng.uniform(0.8, 1.2)), 1.0, 0.05, stairs=False)], [0.3 * UNIT_AXES[5]])


def turns(rng: np.random.Generator) -> ComposedMotion:
    """Slow turns about all axes, 6 degrees about two of them and 10 about the normal."""
    sizes = np.deg2rad([6.0, 6.0, 10.0])
    rates, phases = rng.uniform(0.1, 0.25, 3), rng.uniform(0, 2 * np.pi, 3)
    waves = [Sine(float(rate), float(phase)) for rate, phase in zip(rates, phases, strict=True)]
    return _driven(waves, [size * UNIT_AXES[k] for k, size in enumerate(sizes)])


def sway(rng: np.random.Generator) -> ComposedMotion:
    """An outstretched hand: 3 mm and 1.5 degrees RMS of sway below 1 Hz, and a tremor of 0.05 mm at 8 to 12 Hz."""
    slow = [draw_noise(0.05, 1.0, 1.0, rng) for _ in range(6)]
    tremor = [draw_noise(8.0, 12.0, 0.0, rng) for _ in range(3)]
    sizes = np.r_[np.full(3, np.deg2rad(1.5)), np.full(3, 3.0)]
    return _driven([*slow, *tremor], [*(sizes[:, None] * UNIT_AXES), *(0.05 * UNIT_AXES[3:])])


def lively(rng: np.random.Generator) -> ComposedMotion:
    """All six axes at once, up to about 40 mm/s and 30 degrees/s: fast enough for capture instants to matter."""
    waves = [draw_noise(0.1, 1.0, 0.5, rng) for _ in range(6)]
    sizes = np.r_[np.full(3, 0.05), np.full(3, 4.0)]
    return _driven(waves, list(sizes[:, None] * UNIT_AXES))


MOVEMENTS: dict[str, Movement] = {
    draw.__name__: draw for draw in (still, breathing, irregular, shaker, steps, turns, sway, lively)
}


def _breathing(spec: BreathingSpec, rng: np.random.Generator) -> ComposedMotion:
    waves: list[Waveform] = [draw_breathing(spec, rng), draw_walk(rng), draw_pulse(1.2, 0.04, 0.1, rng)]
    return _driven(waves, np.array([BREATH_SIZE, DRIFT_RMS, PULSE_SIZE]))


def _driven(waves: Sequence[Waveform], directions: Sequence[Array] | Array) -> ComposedMotion:
    return ComposedMotion((WaveformMotion(tuple(waves), np.array(directions), np.zeros(3), from_start=True),))
