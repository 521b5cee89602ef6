"""Movements by name, as chests, hands and test benches make them; each drawn from a generator.

A movement is a displacement of the surface from its rest pose, an exact and smooth function of time. Numbers are those
of facts measured elsewhere: breathing of 10 mm and 3 degrees at 15 breaths a minute with a pulse upon it; the thesis's
shaking table (4.6); its steps of 300 um (its main requirement).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from estimation.se3 import Array
from estimation.synthetic.draws import BreathingSpec, draw_breathing, draw_noise, draw_pulse, draw_walk
from estimation.synthetic.motions import Driven, Motion, shaking_amplitude
from estimation.synthetic.waveforms import Sine, Steps, Waveform

Movement = Callable[[np.random.Generator], Motion]

BREATH = (0.045, 0.01, 0.004, 1.2, 2.5, 9.6)  # rad, mm: about 3 degrees, 10 mm, most of it along the normal
DRIFT = (0.0, 0.0, 0.003, 0.6, 0.6, 0.4)  # rad, mm: RMS after a minute
PULSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.15)  # mm
AXES = np.eye(6)


def still(rng: np.random.Generator) -> Motion:
    """None at all."""
    return Motion(())


def breathing(rng: np.random.Generator) -> Motion:
    """Calm breathing: 10 mm and 3 degrees, breath by breath a little different, a slow drift and a pulse."""
    return _breathing(BreathingSpec(period_spread=0.03, depth_spread=0.05), rng)


def irregular(rng: np.random.Generator) -> Motion:
    """Spontaneous breathing: each breath 10 % longer or shorter and 15 % deeper or flatter."""
    return _breathing(BreathingSpec(), rng)


def shaker(rng: np.random.Generator) -> Motion:
    """The thesis's shaking table at 0.5 Hz: a sine of 7 mm across the surface, up to 22 mm/s."""
    amplitude = shaking_amplitude(0.47, 0.5)
    return _driven([Sine(0.5, float(rng.uniform(0, 2 * np.pi)))], [amplitude * AXES[3]])


def steps(rng: np.random.Generator) -> Motion:
    """Rest, and every second a step of 0.3 mm along the normal, up and down in turn, within 50 ms."""
    return _driven([Steps(float(rng.uniform(0.8, 1.2)), 1.0, 0.05, stairs=False)], [0.3 * AXES[5]])


def turns(rng: np.random.Generator) -> Motion:
    """Slow turns about all axes, 6 degrees about two of them and 10 about the normal."""
    sizes = np.deg2rad([6.0, 6.0, 10.0])
    rates, phases = rng.uniform(0.1, 0.25, 3), rng.uniform(0, 2 * np.pi, 3)
    waves = [Sine(float(rate), float(phase)) for rate, phase in zip(rates, phases, strict=True)]
    return _driven(waves, [size * AXES[k] for k, size in enumerate(sizes)])


def sway(rng: np.random.Generator) -> Motion:
    """A hand held out: 3 mm and 1.5 degrees RMS of sway below 1 Hz, and a tremor of 0.05 mm at 8 to 12 Hz."""
    slow = [draw_noise(0.05, 1.0, 1.0, rng) for _ in range(6)]
    tremor = [draw_noise(8.0, 12.0, 0.0, rng) for _ in range(3)]
    sizes = np.r_[np.full(3, np.deg2rad(1.5)), np.full(3, 3.0)]
    return _driven([*slow, *tremor], [*(sizes[:, None] * AXES), *(0.05 * AXES[3:])])


def lively(rng: np.random.Generator) -> Motion:
    """All six axes at once, up to about 40 mm/s and 30 degrees/s: fast enough for capture instants to show."""
    waves = [draw_noise(0.1, 1.0, 0.5, rng) for _ in range(6)]
    sizes = np.r_[np.full(3, 0.05), np.full(3, 4.0)]
    return _driven(waves, list(sizes[:, None] * AXES))


MOVEMENTS: dict[str, Movement] = {
    made.__name__: made for made in (still, breathing, irregular, shaker, steps, turns, sway, lively)
}


def _breathing(spec: BreathingSpec, rng: np.random.Generator) -> Motion:
    waves: list[Waveform] = [draw_breathing(spec, rng), draw_walk(rng), draw_pulse(1.2, 0.04, 0.1, rng)]
    return _driven(waves, np.array([BREATH, DRIFT, PULSE]))


def _driven(waves: Sequence[Waveform], directions: Sequence[Array] | Array) -> Motion:
    return Motion((Driven(tuple(waves), np.array(directions), np.zeros(3), from_start=True),))
