"""Waveforms whose course is drawn at random: breaths, heartbeats, band-limited noise and a slow walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from estimation.se3 import Array
from estimation.synthetic.waveforms import PULSE_BUMPS, WALK_SECONDS, Cycles, Noise, Walk, breath_bumps

DRAWN_SECONDS = 600.0  # breaths and beats for so long; then they repeat, at rest as they began
WIDEST = 2.5  # standard deviations at which a draw is cut, so that every amplitude has a bound
SINES = 48  # in a band: enough that no beat of two of them stands out
SIGH_LENGTH = 1.5  # a sigh takes longer than a breath


@dataclass(frozen=True, slots=True)
class BreathingSpec:
    """How one breathes. period: s. inspiration: its share. exponent: of the shape, `breath_bumps`.

    period_spread, depth_spread: standard deviations per breath, relative; the defaults are those of irregular
    spontaneous breathing. sighs_per_min of sigh_factor times the depth; pauses_per_min of pause s at end-expiration.
    """

    period: float = 4.0
    inspiration: float = 0.4
    exponent: float = 4.0
    period_spread: float = 0.10
    depth_spread: float = 0.15
    sighs_per_min: float = 0.0
    sigh_factor: float = 2.0
    pauses_per_min: float = 0.0
    pause: float = 5.0


def draw_breathing(spec: BreathingSpec, rng: np.random.Generator) -> Cycles:
    """Breaths from end-expiration (0) to the depth of a usual breath (1) and back, beginning with one at 0 s."""
    count = int(np.ceil(DRAWN_SECONDS / spec.period))
    lengths = spec.period * (1 + spec.period_spread * _bounded(rng, count))
    depths = 1 + spec.depth_spread * _bounded(rng, count)
    sighs = rng.random(count) < spec.sighs_per_min * spec.period / 60
    pauses = rng.random(count) < spec.pauses_per_min * spec.period / 60
    lengths = np.where(sighs, SIGH_LENGTH * lengths, lengths)
    depths = np.where(sighs, spec.sigh_factor * depths, depths)
    starts = np.concatenate([[0.0], np.cumsum(lengths + np.where(pauses, spec.pause, 0.0))])
    return Cycles(starts, lengths, depths, breath_bumps(spec.inspiration, spec.exponent))


def draw_pulse(rate_hz: float, rate_spread: float, depth_spread: float, rng: np.random.Generator) -> Cycles:
    """Heartbeats of height 1: a steep rise, a notch and the smaller wave after it; spreads are relative, per beat."""
    count = int(np.ceil(DRAWN_SECONDS * rate_hz))
    lengths = (1 + rate_spread * _bounded(rng, count)) / rate_hz
    depths = 1 + depth_spread * _bounded(rng, count)
    return Cycles(np.concatenate([[0.0], np.cumsum(lengths)]), lengths, depths, PULSE_BUMPS)


def draw_noise(low_hz: float, high_hz: float, tilt: float, rng: np.random.Generator) -> Noise:
    """Noise of unit RMS between two frequencies, amplitudes falling with the frequency to the power `tilt`."""
    edges = np.linspace(low_hz, high_hz, SINES + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    amplitudes = frequencies**-tilt
    amplitudes *= np.sqrt(2 / np.sum(amplitudes**2))
    return Noise(2 * np.pi * frequencies, amplitudes, rng.uniform(0, 2 * np.pi, SINES))


def draw_walk(rng: np.random.Generator) -> Walk:
    """A random walk from 0 with an RMS of 1 after a minute (and of 2 after four), smooth over a second."""
    knots = np.arange(WALK_SECONDS + 1.0)
    values = np.concatenate([[0.0], np.cumsum(rng.standard_normal(WALK_SECONDS)) / np.sqrt(60)])
    return Walk(CubicSpline(knots, values, bc_type="clamped"))


def _bounded(rng: np.random.Generator, count: int) -> Array:
    return np.clip(rng.standard_normal(count), -WIDEST, WIDEST)
